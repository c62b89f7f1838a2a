#version 330
// Copies the head-up display, a picture with straight alpha, to a corner of the viewport pixel by pixel.

uniform sampler2D picture;
uniform ivec2 corner;
out vec4 pixel;

void main() {
    pixel = texelFetch(picture, ivec2(gl_FragCoord.xy) - corner, 0);
}
