#version 330
// Copies a picture of exactly the target's size.

uniform sampler2D picture;
out vec4 pixel;

void main() {
    pixel = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}
