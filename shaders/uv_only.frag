#version 330
// Writes u and v; coverage is in the depth buffer.

in vec2 v_uv;
out vec2 pixel;

void main() {
    pixel = v_uv;
}
