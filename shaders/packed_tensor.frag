#version 330
// Writes the network's input: C channels of the neural texture, quantised to bytes, four to a 32-bit word.
// q = clamp(roundEven(x / scale) + zero_point, 0, 255); byte b of word l is channel 4 l + b.
// With DEFERRED, u and v come from an image that an earlier pass drew, else from the vertex shader.

uniform sampler2DArray neural;
uniform float scale;
uniform float zero_point;

#ifdef DEFERRED
uniform sampler2D uv_image;
#else
in vec2 v_uv;
#endif
out WORDS packed_pixel;

uint word(vec2 uv, int layer) {
    vec4 real = texture(neural, vec3(uv, float(layer)));
    uvec4 q = uvec4(clamp(roundEven(real / scale) + zero_point, 0.0, 255.0));
    return (q.x | (q.y << 8u)) | ((q.z << 16u) | (q.w << 24u));
}

void main() {
#ifdef DEFERRED
    vec2 uv = texelFetch(uv_image, ivec2(gl_FragCoord.xy), 0).xy;
#else
    vec2 uv = v_uv;
#endif
#if LAYERS == 1
    packed_pixel = word(uv, 0);
#elif LAYERS == 2
    packed_pixel = uvec2(word(uv, 0), word(uv, 1));
#elif LAYERS == 3
    packed_pixel = uvec4(word(uv, 0), word(uv, 1), word(uv, 2), 0u);
#else
    packed_pixel = uvec4(word(uv, 0), word(uv, 1), word(uv, 2), word(uv, 3));
#endif
}
