#version 330
// Premultiplies colours by alpha, in linear light (the sampler decodes sRGB).

uniform sampler2D image;
out vec4 pixel;

void main() {
    vec4 straight = texelFetch(image, ivec2(gl_FragCoord.xy), 0);
    pixel = vec4(straight.rgb * straight.a, straight.a);
}
