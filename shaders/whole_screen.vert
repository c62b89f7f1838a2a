#version 330
// One triangle over the whole target; `place` is 0..1 from the first row and column of the target's memory.

out vec2 place;

void main() {
    place = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(place * 2.0 - 1.0, 0.0, 1.0);
}
