#version 330
// Places a part of the avatar's picture where it lies in the crop rectangle on the screen.

uniform vec4 rect;   // x0, y0, x1, y1 in normalised device coordinates, y up
uniform vec4 source; // left, top, right, bottom of the picture, 0..1 of the texture

in vec4 part; // left, top, right, bottom, 0..1 of the crop rectangle

out vec2 v_uv;

void main() {
    vec2 place = mix(part.xy, part.zw, vec2(gl_VertexID & 1, gl_VertexID >> 1));
    vec2 ndc = mix(rect.xw, rect.zy, place);
    gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
    v_uv = mix(source.xy, source.zw, place);
}
