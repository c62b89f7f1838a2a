#version 330
// Writes the network's input: C channels of the neural texture, quantised to bytes, four to a 32-bit word.
// q = clamp(roundEven(x / scale) + zero_point, 0, 255); byte b of word l is channel 4 l + b.
// With DEFERRED, u and v come from an image that an earlier pass drew, else from the vertex shader.

uniform float scale;
uniform float zero_point;

out WORDS packed_pixel;

uint word(vec4 real) {
    uvec4 q = uvec4(clamp(roundEven(real / scale) + zero_point, 0.0, 255.0));
    return (q.x | (q.y << 8u)) | ((q.z << 16u) | (q.w << 24u));
}

#ifdef DEFERRED
// All channels of a texel lie side by side, so a pixel reads three cache lines, not eight. A uvec4 has eight channels:
// the low halves of its words are four channels, the high halves are the next four.
uniform usampler2D neural;
uniform float unit; // factor on the texture's numbers, because the bits of FP16 are read as bits of FP32
uniform sampler2D uv_image;

vec4 low(uvec4 halves) {
    return uintBitsToFloat(((halves & 0x7fffu) << 13u) | ((halves & 0x8000u) << 16u));
}

vec4 high(uvec4 halves) {
    return uintBitsToFloat(((halves >> 3u) & 0x0fffe000u) | (halves & 0x80000000u));
}

// Interpolates between four numbers. The formula gives exactly the same number if all four are equal.
vec4 between(vec4 a, vec4 b, vec4 c, vec4 d, vec2 share) {
    vec4 upper = a + share.x * (b - a);
    vec4 lower = c + share.x * (d - c);
    return (upper + share.y * (lower - upper)) * unit;
}

void read(out uint words[4]) {
    vec2 uv = texelFetch(uv_image, ivec2(gl_FragCoord.xy), 0).xy;
    ivec2 last = textureSize(neural, 0) / ivec2(EIGHTHS, 1) - 1;
    vec2 place = uv * vec2(last + 1) - 0.5;
    vec2 share = place - floor(place);
    ivec2 near = clamp(ivec2(floor(place)), ivec2(0), last);
    ivec2 far = clamp(ivec2(floor(place)) + 1, ivec2(0), last);
    for (int n = 0; n < EIGHTHS; ++n) {
        uvec4 a = texelFetch(neural, ivec2(EIGHTHS * near.x + n, near.y), 0);
        uvec4 b = texelFetch(neural, ivec2(EIGHTHS * far.x + n, near.y), 0);
        uvec4 c = texelFetch(neural, ivec2(EIGHTHS * near.x + n, far.y), 0);
        uvec4 d = texelFetch(neural, ivec2(EIGHTHS * far.x + n, far.y), 0);
        words[2 * n] = word(between(low(a), low(b), low(c), low(d), share));
        words[2 * n + 1] = word(between(high(a), high(b), high(c), high(d), share));
    }
}
#else
uniform sampler2DArray neural;

in vec2 v_uv;

void read(out uint words[4]) {
    for (int layer = 0; layer < LAYERS; ++layer)
        words[layer] = word(texture(neural, vec3(v_uv, float(layer))));
}
#endif

void main() {
    uint words[4];
    read(words);
#if LAYERS == 1
    packed_pixel = words[0];
#elif LAYERS == 2
    packed_pixel = uvec2(words[0], words[1]);
#elif LAYERS == 3
    packed_pixel = uvec4(words[0], words[1], words[2], 0u);
#else
    packed_pixel = uvec4(words[0], words[1], words[2], words[3]);
#endif
}
