#version 330
// Draws the room. Texture and light are multiplied as sRGB values, because both were painted for that.

uniform sampler2D detail;

in vec2 v_uv;
in vec3 v_light;
out vec4 pixel;

void main() {
    pixel = vec4(texture(detail, v_uv).rgb * v_light, 1.0);
}
