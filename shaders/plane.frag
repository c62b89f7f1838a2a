#version 330
// Draws a plane as a faint sheet with lines every STEP metres and at its rim, about a pixel wide at any distance.

in vec2 v_metres;
flat in vec2 v_half;
out vec4 pixel;

const float STEP = 0.25;
const float SHEET = 0.10;
const float LINE = 0.45;

float line(vec2 metres, vec2 pixel_metres) {
    vec2 reach = 1.0 - clamp(metres / max(pixel_metres, vec2(1e-6)), 0.0, 1.0);
    return max(reach.x, reach.y);
}

void main() {
    vec2 pixel_metres = fwidth(v_metres);
    vec2 inner = abs(fract(v_metres / STEP + 0.5) - 0.5) * STEP;
    float crowded = clamp(2.0 * max(pixel_metres.x, pixel_metres.y) / STEP, 0.0, 1.0); // 1 where the lines merge
    float shown = max(line(inner, pixel_metres) * (1.0 - crowded), line(v_half - abs(v_metres), pixel_metres));
    pixel = vec4(1.0, 1.0, 1.0, mix(SHEET, LINE, shown));
}
