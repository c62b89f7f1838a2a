#version 330
// Box filter of SAMPLES x SAMPLES linear-light samples, weighted by alpha, to sRGB with straight alpha.

uniform sampler2D samples;
out vec4 pixel;

vec3 srgb(vec3 linear) {
    vec3 light = clamp(linear, 0.0, 1.0);
    return mix(12.92 * light, 1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * SAMPLES;
    vec3 light = vec3(0.0);
    float alpha = 0.0;
    for (int y = 0; y < SAMPLES; ++y) {
        for (int x = 0; x < SAMPLES; ++x) {
            vec4 texel = texelFetch(samples, first + ivec2(x, y), 0);
            light += texel.rgb * texel.a;
            alpha += texel.a;
        }
    }
    pixel = vec4(srgb(light / max(alpha, 1e-6)), alpha / float(SAMPLES * SAMPLES));
}
