#version 330
// One triangle over the whole target. `place` is 0 at the first row and column of the target's memory, 1 at the last.

out vec2 place;

void main() {
    place = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(place * 2.0 - 1.0, 0.0, 1.0);
}
