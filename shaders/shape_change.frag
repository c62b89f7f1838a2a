#version 330
// Blends the picture that was there before the tensor changed its shape into the premultiplied picture of one avatar.

uniform sampler2D image;  // the new one, straight alpha
uniform sampler2D before; // premultiplied
uniform vec4 cell;        // left, top, right, bottom of the avatar in the new one, pixels
uniform vec4 part;        // the same of the one before
uniform vec4 old_from_new; // scale x, y, then offset x, y: from pixels of the new one to those of the one before
uniform float share;      // of the one before

out vec4 pixel;

void main() {
    vec2 place = gl_FragCoord.xy;
    vec2 old = place * old_from_new.xy + old_from_new.zw;
    if (any(lessThan(place, cell.xy)) || any(greaterThan(place, cell.zw)) || any(lessThan(old, part.xy)) ||
        any(greaterThan(old, part.zw))) {
        discard;
    }
    vec4 straight = texelFetch(image, ivec2(place), 0);
    vec2 read = clamp(old, part.xy + 0.5, part.zw - 0.5) / vec2(textureSize(before, 0));
    pixel = mix(vec4(straight.rgb * straight.a, straight.a), textureLod(before, read, 0.0), share);
}
