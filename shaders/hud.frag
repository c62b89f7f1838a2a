#version 330
// A picture of text, straight alpha, copied to the viewport's corner pixel by pixel.

uniform sampler2D picture;
uniform ivec2 corner;
out vec4 pixel;

void main() {
    pixel = texelFetch(picture, ivec2(gl_FragCoord.xy) - corner, 0);
}
