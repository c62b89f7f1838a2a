#version 330
// Places walls, floor and ceiling: light is baked per vertex, detail comes from a repeating texture.

uniform mat4 clip_from_world;

in vec3 position;
in vec2 uv;
in vec3 light;

out vec2 v_uv;
out vec3 v_light;

void main() {
    gl_Position = clip_from_world * vec4(position, 1.0);
    v_uv = uv;
    v_light = light;
}
