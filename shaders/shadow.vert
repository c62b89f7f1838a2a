#version 330
// Places a disc on the floor for each contact shadow.

uniform mat4 clip_from_world;
uniform vec4 blob[BLOBS]; // x, z, radius, strength

out vec2 v_place;
flat out float v_strength;

void main() {
    vec4 disc = blob[gl_VertexID / 6];
    int corner = gl_VertexID % 6;
    v_place = vec2(corner == 1 || corner == 2 || corner == 4 ? 1.0 : -1.0, corner == 2 || corner > 3 ? 1.0 : -1.0);
    v_strength = disc.w;
    gl_Position = clip_from_world * vec4(disc.x + v_place.x * disc.z, 0.0, disc.y + v_place.y * disc.z, 1.0);
}
