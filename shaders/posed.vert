#version 330
// Vertices that the CPU unit has posed already.

uniform mat4 clip_from_world;

in vec3 position;
in vec2 uv;

out vec2 v_uv;

void main() {
    gl_Position = clip_from_world * vec4(position, 1.0);
    v_uv = uv;
}
