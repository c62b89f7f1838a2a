#version 330
// The packed pass: C channels of the neural texture, quantised, four to a 32-bit word, in one write.
// q = clamp(roundEven(x / scale) + zero_point, 0, 255); byte b of word l is channel 4 l + b.

uniform sampler2DArray neural;
uniform float scale;
uniform float zero_point;

in vec2 v_uv;
out WORDS packed_pixel;

uint word(int layer) {
    vec4 real = texture(neural, vec3(v_uv, float(layer)));
    uvec4 q = uvec4(clamp(roundEven(real / scale) + zero_point, 0.0, 255.0));
    return (q.x | (q.y << 8u)) | ((q.z << 16u) | (q.w << 24u));
}

void main() {
#if LAYERS == 1
    packed_pixel = word(0);
#elif LAYERS == 2
    packed_pixel = uvec2(word(0), word(1));
#elif LAYERS == 3
    packed_pixel = uvec4(word(0), word(1), word(2), 0u);
#else
    packed_pixel = uvec4(word(0), word(1), word(2), word(3));
#endif
}
