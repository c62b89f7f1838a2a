#version 330
// Writes the share of light that a contact shadow removes, as alpha. The share falls smoothly to 0 at the rim.

in vec2 v_place;
flat in float v_strength;
out vec4 pixel;

void main() {
    float left = max(1.0 - dot(v_place, v_place), 0.0);
    pixel = vec4(0.0, 0.0, 0.0, v_strength * left * left);
}
