#version 330
// Places a rectangle in the world for each detected plane.

uniform mat4 clip_from_world;
uniform vec3 centre[PLANES];
uniform vec3 across[PLANES]; // half a side, metres
uniform vec3 along[PLANES];  // half the other side, at right angles to it

out vec2 v_metres;    // from the centre
flat out vec2 v_half; // half the sides, metres

void main() {
    int plane = gl_VertexID / 6;
    int corner = gl_VertexID % 6;
    vec2 place = vec2(corner == 1 || corner == 2 || corner == 4 ? 1.0 : -1.0, corner == 2 || corner > 3 ? 1.0 : -1.0);
    v_half = vec2(length(across[plane]), length(along[plane]));
    v_metres = place * v_half;
    gl_Position = clip_from_world * vec4(centre[plane] + place.x * across[plane] + place.y * along[plane], 1.0);
}
