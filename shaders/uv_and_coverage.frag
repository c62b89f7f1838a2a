#version 330
// Writes the UV image: u, v and coverage.

in vec2 v_uv;
out vec4 pixel;

void main() {
    pixel = vec4(v_uv, 1.0, 1.0);
}
