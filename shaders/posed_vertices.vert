#version 330
// Draws vertices that the CPU unit has skinned.

uniform mat4 clip_from_world;

in vec3 position;
in vec2 uv;

out vec2 v_uv;

void main() {
    gl_Position = clip_from_world * vec4(position, 1.0);
    v_uv = uv;
}
