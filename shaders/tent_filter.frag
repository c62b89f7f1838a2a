#version 330
// Turns SAMPLES x SAMPLES samples a pixel, in linear light, into sRGB with straight alpha. A pixel is the mean under a
// tent filter two pixels wide, weighted by alpha. SAMPLES is even. Beyond the border the outermost samples repeat.

uniform sampler2D samples;
out vec4 pixel;

vec3 srgb(vec3 linear) {
    vec3 light = clamp(linear, 0.0, 1.0);
    return mix(12.92 * light, 1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}

float tent(int tap) {
    return 1.0 - abs((float(tap) + 0.5) / float(SAMPLES) - 0.5);
}

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * SAMPLES;
    ivec2 last = textureSize(samples, 0) - 1;
    vec3 light = vec3(0.0);
    float alpha = 0.0;
    float total = 0.0;
    for (int y = -SAMPLES / 2; y < SAMPLES + SAMPLES / 2; ++y) {
        for (int x = -SAMPLES / 2; x < SAMPLES + SAMPLES / 2; ++x) {
            vec4 texel = texelFetch(samples, clamp(first + ivec2(x, y), ivec2(0), last), 0);
            float weight = tent(x) * tent(y);
            light += weight * texel.rgb * texel.a;
            alpha += weight * texel.a;
            total += weight;
        }
    }
    pixel = vec4(srgb(light / max(alpha, 1e-6)), alpha / total);
}
