#version 330
// Reads the premultiplied picture, averaged over the pixel's footprint with TAPS x TAPS bilinear reads.

uniform sampler2D picture;
uniform vec4 inside; // limits of the reads: left, top, right, bottom, 0..1 of the texture

in vec2 v_uv;
out vec4 pixel;

void main() {
#if TAPS == 1
    pixel = textureLod(picture, clamp(v_uv, inside.xy, inside.zw), 0.0);
#else
    vec2 right = dFdx(v_uv);
    vec2 down = dFdy(v_uv);
    vec4 sum = vec4(0.0);
    for (int y = 0; y < TAPS; ++y) {
        for (int x = 0; x < TAPS; ++x) {
            vec2 place = (vec2(x, y) + 0.5) / float(TAPS) - 0.5;
            sum += textureLod(picture, clamp(v_uv + place.x * right + place.y * down, inside.xy, inside.zw), 0.0);
        }
    }
    pixel = sum / float(TAPS * TAPS);
#endif
}
