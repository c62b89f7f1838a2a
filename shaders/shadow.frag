#version 330
// Draws a contact shadow, which falls smoothly to 0 at the rim. The blending multiplies sRGB numbers by alpha, and
// subtracts the colour. Light times k turns the sRGB number s into (s + 0.055) k^(1/2.4) - 0.055. Therefore the result
// is as if blended in linear light, except for numbers below 0.04, where sRGB is a straight line.

in vec2 v_place;
flat in float v_strength; // at most 0.72
out vec4 pixel;

void main() {
    float left = max(1.0 - dot(v_place, v_place), 0.0);
    float dark = v_strength * left * left;
    float kept = 1.0 - dark * (0.43238 + dark * (0.01423 + dark * 0.24720)); // (1 - dark)^(1/2.4) within 0.0007
    pixel = vec4(vec3(0.055 * (1.0 - kept)), kept);
}
