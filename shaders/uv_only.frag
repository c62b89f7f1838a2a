#version 330
// u and v alone; coverage is in the depth buffer.

in vec2 v_uv;
out vec2 pixel;

void main() {
    pixel = v_uv;
}
