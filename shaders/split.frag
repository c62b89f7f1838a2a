#version 330
// Writes four channels of the tensor, quantised as in the packed pass, one byte to each colour channel.
// `trilane bench raster` compares the packed pass with such passes.

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
