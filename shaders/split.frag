#version 330
// Writes one layer of four channels, quantised as the packed pass does, one byte to a colour channel: the baseline of
// `trilane bench raster` that draws the tensor in several passes.

uniform sampler2DArray neural;
uniform float scale;
uniform float zero_point;
uniform int layer;

in vec2 v_uv;
out vec4 pixel;

void main() {
    vec4 real = texture(neural, vec3(v_uv, float(layer)));
    pixel = clamp(roundEven(real / scale) + zero_point, 0.0, 255.0) / 255.0;
}
