#version 330
// One triangle over the whole viewport at the greatest depth. A greater-than test passes where something was drawn.

void main() {
    vec2 place = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(place * 2.0 - 1.0, 1.0, 1.0);
}
