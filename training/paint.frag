#version 330
// Paints the clothed body: where each layer ends, its colours, and the light of a soft lamp on the camera.
// Everything is placed by the point at rest, `v_rest` (metres), relative to landmarks of the body.
// The definitions in capitals come from the look (`Look` in `clothing.py`): colours in sRGB; HAIRLINE, FRINGE and WHORL
// of the hair, EAR_RING round the ears; the ends of sleeves (SLEEVE_END), trouser legs (LEGS_END) and socks (SOCK_END);
// LEG_KEPT of the skin inside of trouser legs.
// v_colour: r is the obscurance, 1 in the open; g is 1 on the eyeballs.

in vec3 v_position;
in vec3 v_normal;
in vec3 v_rest;
in vec4 v_colour;

uniform mat4 view;
uniform vec3 eye;
uniform int material;      // 0 skin, 1 trousers, 2 shirt, 3 hair, 4 shoe, 5 sole, 6 shorts, 7 jacket, 8 bob, 9 blouse, 10 skirt, 11 cap, 12 long hair
uniform vec3 eyeball;      // centre of the left one
uniform float eyeball_radius;
uniform vec3 ear;          // tip of the left one
uniform vec3 pelvis;
uniform vec3 hip;          // left
uniform vec3 neck;
uniform vec3 shoulder;     // left
uniform vec3 elbow;        // left
uniform vec3 ankle;        // left
uniform vec3 toes;         // left, root of the toes

out vec4 pixel;

float band(float x, float half_width, float soft) {  // 1 where |x| < half_width
    return 1.0 - smoothstep(half_width - soft, half_width + soft, abs(x));
}

float over(float x, float soft) {  // 1 where x > 0
    return smoothstep(-soft, soft, x);
}

float blob(vec2 p, vec2 radius, float soft) {
    return 1.0 - smoothstep(1.0 - soft, 1.0 + soft, length(p / radius));
}

float rough(vec3 p) {  // smooth, about -1..1
    return (sin(p.x + 1.7 * sin(p.y)) + sin(p.y * 1.3 + 2.1 * sin(p.z * 0.9)) + sin(p.z * 1.1 + 1.9 * sin(p.x * 0.8))) / 3.0;
}

float hairline(vec3 p) {  // > 0 in the hair
    vec3 q = p - vec3(0.0, eyeball.yz);
    float side = abs(q.x);
    float forehead = HAIRLINE.x + FRINGE * 0.007 * sin(70.0 * q.x + 1.0) + FRINGE * 0.004 * sin(170.0 * q.x) + FRINGE * 0.012 * smoothstep(0.03, 0.0, abs(q.x - 0.022));
    float nape = HAIRLINE.z + 0.006 * sin(90.0 * q.x);
    float line = mix(HAIRLINE.y, forehead, smoothstep(-0.052, -0.030, q.z));
    line = mix(line, nape, smoothstep(ear.z - eyeball.z - 0.012, ear.z - eyeball.z - 0.024, q.z));
    float ring = length((p.zy - ear.zy - vec2(0.000, -0.016)) / (EAR_RING * vec2(0.023, 0.032))) - 1.0;
    float around = side > 0.045 ? ring * 0.025 : 1.0;
    return min(q.y - line, around);
}

vec3 paint_eye(vec3 p) {
    vec3 q = p - vec3(sign(p.x) * eyeball.x, eyeball.yz);
    float r = length(q.xy + vec2(0.0, 0.0016)) / eyeball_radius;
    vec3 c = mix(vec3(0.95, 0.93, 0.91), vec3(0.86, 0.70, 0.66), smoothstep(0.55, 1.0, r));
    vec3 iris = mix(IRIS * 1.25, IRIS * 0.45, smoothstep(0.18, 0.40, r));
    c = mix(c, iris, 1.0 - smoothstep(0.38, 0.43, r));
    c = mix(c, vec3(0.03), 1.0 - smoothstep(0.15, 0.19, r));
    return mix(c, vec3(1.0), blob(q.xy - vec2(0.0018, 0.0000), vec2(0.0012), 0.3));
}

vec3 paint_skin(vec3 p) {
    if (v_colour.g > 0.5) return paint_eye(p);
    vec3 q = p - vec3(0.0, eyeball.yz);
    float s = abs(q.x);
    vec3 c = SKIN * (1.0 + 0.025 * rough(p * 40.0));
    float face = over(q.z + 0.045, 0.02) * over(p.y - neck.y - 0.02, 0.02);
    c = mix(c, BLUSH, 0.28 * face * blob(vec2(s - 0.040, q.y + 0.036), vec2(0.026, 0.022), 0.8));
    c = mix(c, BLUSH, 0.25 * face * blob(vec2(s, q.y + 0.036), vec2(0.015, 0.014), 0.7) * over(q.z - 0.018, 0.01));
    c = mix(c, BLUSH, 0.45 * blob((p - vec3(sign(p.x) * ear.x, ear.yz)).zy, vec2(0.03, 0.04), 0.5) * over(s - ear.x + 0.02, 0.006));
    c = mix(c, c * vec3(0.92, 0.84, 0.82), face * blob(vec2(s - eyeball.x, q.y - 0.001), vec2(0.020, 0.010), 0.7));
    // mouth: lips round a dark line
    float x = q.x / 0.0250, m = q.y + 0.0735 - 0.0004 * x * x;
    float fall = max(1.0 - x * x, 0.0);
    float upper = 0.0072 * pow(fall, 0.7) * (1.0 - 0.28 * exp(-pow(q.x / 0.0042, 2.0)));
    float lower = 0.0100 * pow(fall, 0.6);
    float lips = over(upper - m, 0.0010) * over(m + lower, 0.0010) * over(1.0 - abs(x), 0.03) * face;
    c = mix(c, LIP * (m > 0.0 ? 0.88 : 1.06), lips);
    c = mix(c, vec3(0.25, 0.09, 0.08), face * band(m, 0.0007, 0.0006) * over(1.04 - abs(x), 0.06));
    // nostrils
    c = mix(c, vec3(0.30, 0.13, 0.10), face * 0.85 * blob(vec2(s - 0.0090, q.y + 0.0480), vec2(0.0048, 0.0022), 0.4) * over(q.z - 0.010, 0.004));
    // brows and lashes
    float t = (s - 0.0120) / 0.038;
    float arch = 0.0125 + 0.0060 * sin(2.4 * clamp(t, 0.0, 1.0)) - 0.002 * t;
    float brow = band(q.y - arch, mix(0.0032, 0.0013, clamp(t, 0.0, 1.0)), 0.0009) * over(t, 0.03) * over(1.0 - t, 0.03);
    c = mix(c, BROW, 0.85 * face * brow);
    vec2 lid = vec2(s - 0.0320, q.y + 0.0018) / vec2(0.0115, 0.0040);
    float lash = band(length(lid) - 1.05, mix(0.10, 0.26, over(lid.y, 0.3)), 0.12) * mix(0.30, 0.92, over(lid.y, 0.3));
    c = mix(c, vec3(0.12, 0.07, 0.06), face * lash);
    c = mix(c, SOCK * (0.92 + 0.08 * sin(700.0 * p.y)), over(ankle.y + SOCK_END - p.y, 0.0015));
    // the scalp under the hair
    return mix(c, HAIR * 0.8, 0.9 * smoothstep(0.0, 0.006, hairline(p)) * over(p.y - neck.y - 0.03, 0.01));
}

vec3 paint_shirt(vec3 p) {
    vec3 c = SHIRT * (1.0 + 0.06 * rough(p * vec3(25.0, 18.0, 25.0)));
    float chest = shoulder.y - 0.135;
    c = mix(c, TRIM, band(p.y - chest, 0.040, 0.0015) * over(shoulder.x - 0.012 - abs(p.x), 0.003));
    float cuff = mix(shoulder.x, elbow.x, SLEEVE_END);
    c = mix(c, TRIM, over(abs(p.x) - cuff + 0.026, 0.0015));
    c = mix(c, c * 0.80, band(abs(p.x) - shoulder.x + 0.012, 0.0030, 0.0020) * over(p.y - shoulder.y + 0.10, 0.01));        // shoulder seam
    c = mix(c, c * 0.82, band(p.y - hip.y + 0.042, 0.0030, 0.0020));                    // hem stitch
    float tilt = p.y - neck.y + 0.45 * (p.z - neck.z);
    c = mix(c, TRIM, over(tilt + 0.012, 0.0015) * over(0.115 - length(p.xz - neck.xz), 0.0015));                                      // collar
    float front = over(p.z - neck.z - 0.03, 0.005);
    float placket = front * over(p.y - chest - 0.053, 0.001) * over(-0.012 - tilt, 0.0015);
    c = mix(c, SHIRT * 0.72, placket * band(p.x, 0.017, 0.0012));
    for (int i = 0; i < 2; ++i) {
        float y = mix(chest + 0.053, neck.y - 0.06, 0.25 + 0.45 * float(i));
        c = mix(c, TRIM, placket * blob(vec2(p.x, p.y - y), vec2(0.0055), 0.15));
    }
    return c;
}

vec3 paint_trousers(vec3 p) {
    float front = step(hip.z, p.z);
    vec2 leg = vec2(abs(p.x) - mix(hip.x, ankle.x, clamp((hip.y - p.y) / (hip.y - ankle.y), 0.0, 1.0)), p.z - hip.z);
    vec3 c = TROUSERS * (1.0 + 0.07 * rough(p * vec3(22.0, 15.0, 22.0)));
    float worn = blob(vec2(leg.x, (p.y - mix(hip.y, ankle.y, 0.35)) * 0.35), vec2(0.06, 0.08), 0.8) * front;
    c = mix(c, TROUSERS * 1.45, 0.45 * worn);
    c = mix(c, STITCH, 0.8 * band(p.z - mix(hip.z + 0.005, ankle.z, clamp((hip.y - p.y) / (hip.y - ankle.y), 0.0, 1.0)), 0.0022, 0.0012) * step(0.0, leg.x));
    c = mix(c, STITCH, 0.8 * band(p.y - ankle.y - 0.030, 0.0020, 0.0012));
    float pocket = (p.y - hip.y + 0.045) - 1.1 * (abs(p.x) - 0.115);
    c = mix(c, STITCH, 0.85 * front * band(pocket, 0.0026, 0.0014) * over(abs(p.x) - 0.075, 0.004));
    c = mix(c, TROUSERS * 0.6, front * band(p.x, 0.0022, 0.0012) * over(p.y - hip.y + 0.075, 0.004));
    float back = 1.0 - front;
    vec2 b = vec2(abs(p.x) - 0.085, p.y - hip.y + 0.055);
    float edge = max(abs(b.x) / 0.048, abs(b.y + 0.010 * (1.0 - abs(b.x) / 0.048)) / 0.055);
    return mix(c, STITCH, 0.85 * back * band(edge - 1.0, 0.05, 0.02));
}

vec3 paint_jacket(vec3 p) {
    float sleeve = abs(p.x) - shoulder.x, front = step(neck.z, p.z), side = sign(p.x);
    vec3 c = SHIRT * (1.0 + 0.05 * rough(p * vec3(21.0, 27.0, 21.0)));
    float chest = shoulder.y - 0.10;
    c = mix(c, TRIM, over(p.y - chest - 0.35 * max(sleeve + 0.06, 0.0), 0.0015));             // yoke
    c = mix(c, SHIRT * 0.62, band(p.y - chest - 0.35 * max(sleeve + 0.06, 0.0), 0.0026, 0.0015));
    c = mix(c, TRIM, band(p.z - shoulder.z, 0.012, 0.0015) * over(sleeve - 0.05, 0.003));       // down the sleeve
    float cuff = mix(shoulder.x, elbow.x, SLEEVE_END) - 0.040, hem = hip.y + 0.025;
    float rib = 0.86 + 0.14 * sin((abs(p.x) < shoulder.x ? p.x + p.z : p.y + p.z) * 900.0);
    c = mix(c, TRIM * 0.55 * rib, max(over(abs(p.x) - cuff, 0.0015), over(hem - p.y, 0.0015)));
    // zip, pockets on the front, a badge on its left
    float middle = front * over(0.06 - abs(p.x), 0.001);
    c = mix(c, SHIRT * 0.45, middle * band(p.x, 0.011, 0.0012));
    c = mix(c, RUBBER, middle * band(p.x, 0.0032, 0.0010) * over(fract(p.y * 130.0) - 0.35, 0.12));
    float pocket = p.y - hip.y - 0.13 - 0.9 * (abs(p.x) - 0.10);
    c = mix(c, SHIRT * 0.42, front * band(pocket, 0.0040, 0.0015) * band(abs(p.x) - 0.095, 0.034, 0.002));
    c = mix(c, RUBBER, front * over(side, 0.1) * blob(vec2(p.x - 0.085, p.y - chest + 0.050), vec2(0.021), 0.06));
    c = mix(c, STITCH, front * over(side, 0.1) * blob(vec2(p.x - 0.085, p.y - chest + 0.050), vec2(0.015), 0.08));
    return mix(c, c * 0.75, band(sleeve + 0.012, 0.0030, 0.0020) * over(p.y - shoulder.y + 0.10, 0.01));  // shoulder seam
}

vec3 paint_shorts(vec3 p) {
    float front = step(hip.z, p.z), end = ankle.y + LEGS_END;
    vec3 c = TROUSERS * (1.0 + 0.06 * rough(p * vec3(24.0, 17.0, 24.0)));
    vec2 b = vec2(p.z - hip.z, p.y - end - 0.155);                                                      // pocket on the thigh
    float outer = over(abs(p.x) - hip.x - 0.03, 0.004), edge = max(abs(b.x) / 0.055, abs(b.y) / 0.065);
    c = mix(c, TROUSERS * 1.14, outer * over(1.0 - edge, 0.02));
    c = mix(c, STITCH, 0.85 * outer * band(edge - 1.0, 0.035, 0.02));
    c = mix(c, TROUSERS * 0.70, outer * over(1.0 - edge, 0.02) * band(b.y - 0.030, 0.0030, 0.0015));  // its flap
    c = mix(c, STITCH, 0.8 * band(p.y - end - 0.022, 0.0022, 0.0012));
    c = mix(c, TROUSERS * 0.6, front * band(p.x, 0.0024, 0.0012) * over(p.y - hip.y + 0.075, 0.004));
    return mix(c, STITCH, 0.8 * (1.0 - front) * band(p.x, 0.0022, 0.0012) * over(p.y - hip.y + 0.10, 0.004));
}

vec3 paint_hair(vec3 p) {
    vec3 q = p - vec3(0.0, eyeball.y + 0.03, eyeball.z - 0.09);
    vec3 d = normalize(q);
    vec3 whorl = normalize(WHORL), across = normalize(cross(whorl, vec3(1.0, 0.0, 0.0)));
    float along = atan(dot(d, cross(across, whorl)), dot(d, across)) * 10.0 + 3.0 * dot(d, whorl);
    float calm = smoothstep(0.98, 0.80, dot(d, whorl));
    float strands = 0.5 + 0.5 * calm * sin(along * 2.0 + 1.5 * sin(along));
    vec3 c = mix(HAIR, STRANDS, 0.10 + 0.20 * strands);
    float shine = band(q.y - 0.062 - 0.012 * sin(along), 0.016, 0.016);
    c = mix(c, STRANDS * 1.2, 0.35 * shine);
    return mix(c * 0.6, c, smoothstep(0.0, 0.012, hairline(p)));
}

float neckline(vec3 p) {  // of the blouse, > 0 where the neck is bare
    float tilt = p.y - neck.y + 0.45 * (p.z - neck.z) - 0.012;
    float scoop = 0.085 * (1.0 - length(vec2(p.x / 0.088, min(tilt, 0.0) / 0.085)));
    return p.z > neck.z ? max(tilt, scoop) : tilt;
}

vec3 paint_blouse(vec3 p) {
    float open = neckline(p), front = over(p.z - neck.z - 0.02, 0.005);
    vec3 c = SHIRT * (1.0 + 0.05 * rough(p * vec3(23.0, 16.0, 23.0)));
    c = mix(c, TRIM, over(abs(p.x) - mix(shoulder.x, elbow.x, SLEEVE_END) + 0.018, 0.0015));
    c = mix(c, TRIM, over(open + 0.016, 0.0015) * over(0.14 - length(p.xz - neck.xz), 0.002));
    c = mix(c, SHIRT * 0.72, front * band(abs(p.x) - 0.016, 0.0016, 0.0010) * over(-0.016 - open, 0.0015));
    float button = fract((p.y - pelvis.y) / 0.065) - 0.5;
    c = mix(c, TRIM, front * blob(vec2(p.x, button * 0.065), vec2(0.0060), 0.15) * over(-0.030 - open, 0.0015));
    return mix(c, c * 0.80, band(abs(p.x) - shoulder.x + 0.006, 0.0030, 0.0020) * over(p.y - shoulder.y + 0.10, 0.01));
}

vec3 paint_skirt(vec3 p) {
    float above = p.y - ankle.y - LEGS_END;
    vec3 c = TROUSERS * (1.0 + 0.05 * rough(p * vec3(19.0, 9.0, 19.0)));
    c = mix(c, STITCH, band(above - 0.045, 0.011, 0.0015));
    c = mix(c, STITCH, 0.8 * band(above - 0.070, 0.0030, 0.0015));
    return mix(c, TROUSERS * 0.55, over(p.y - pelvis.y - 0.068, 0.0015));                   // waistband
}

vec3 paint_long_hair(vec3 p) {
    float along = 9.0 * atan(p.x, ear.z - p.z) + 0.6 * sin(17.0 * p.y);
    float strands = 0.5 + 0.5 * sin(along * 2.0 + 1.5 * sin(along));
    vec3 c = mix(HAIR, STRANDS, 0.10 + 0.25 * strands);
    return mix(c, HAIR * 0.8, 0.6 * smoothstep(neck.y, neck.y - 0.25, p.y));
}

vec3 paint_shoe(vec3 p) {
    float side = sign(p.x);
    vec3 axis = normalize(vec3(toes.x - ankle.x, 0.0, toes.z - ankle.z));
    vec3 q = vec3(abs(p.x), p.yz) - ankle;
    float along = q.x * axis.x + q.z * axis.z, across = q.x * axis.z - q.z * axis.x;
    vec3 c = SHOE * (1.0 + 0.04 * rough(p * 60.0));
    float top = over(along - 0.035, 0.003) * over(0.122 - along, 0.003);
    float tongue = band(across, 0.024, 0.0012) * top;
    c = mix(c, SHOE * 0.62, tongue);
    float lace = band(fract((along - 0.040) / 0.020) - 0.5, 0.20, 0.06);
    c = mix(c, RUBBER, lace * band(across, 0.021, 0.0012) * over(along - 0.040, 0.002) * over(0.118 - along, 0.002));
    c = mix(c, RUBBER, over(along - 0.165, 0.0025));                                     // toe cap
    c = mix(c, RUBBER, over(-along - 0.030, 0.002) * over(q.y + 0.02, 0.002));            // heel tab
    float stripe = band(along - 0.035 + 0.7 * q.y, 0.012, 0.0015) * over(abs(across) - 0.026, 0.0015);
    c = mix(c, RUBBER, stripe);
    return mix(c, SHOE * 0.45, over(q.y - 0.022, 0.0015));                               // lining at the ankle
}

vec3 paint_sole(vec3 p) {
    float ground = ankle.y - p.y;
    return RUBBER * mix(1.0, 0.62, band(ground - 0.084, 0.0022, 0.001));
}

bool cut(vec3 p) {
    float tilt = p.y - neck.y + 0.45 * (p.z - neck.z);
    if (material == 0) {  // skin well inside a garment
        bool in_shirt = abs(p.x) < mix(shoulder.x, elbow.x, SLEEVE_END - 0.35) && tilt < -0.13 && p.y > hip.y;
        bool in_trousers = p.y < hip.y + 0.05 && p.y > ankle.y + LEGS_END + LEG_KEPT && abs(p.x) < shoulder.x + 0.1;
        return in_shirt || in_trousers || p.y < ankle.y - 0.01;
    }
    if (material == 1 || material == 6) return p.y < ankle.y + LEGS_END || p.y > hip.y + 0.06;
    if (material == 2) {
        bool open = p.z > neck.z && tilt > -0.085 + abs(p.x) * 2.6;
        return abs(p.x) > mix(shoulder.x, elbow.x, SLEEVE_END) || p.y < hip.y - 0.055 || tilt > 0.024 || open;
    }
    if (material == 3 || material == 8 || material == 11) return hairline(p) < 0.0;
    if (material == 9) return abs(p.x) > mix(shoulder.x, elbow.x, SLEEVE_END) || p.y < hip.y + 0.06 || neckline(p) > 0.0;
    if (material == 7) return abs(p.x) > mix(shoulder.x, elbow.x, SLEEVE_END) || p.y < hip.y - 0.020 || tilt > 0.034;
    return false;
}

vec3 paint(vec3 p) {
    if (material == 0) return paint_skin(p);
    if (material == 1) return paint_trousers(p);
    if (material == 2) return paint_shirt(p);
    if (material == 3 || material == 8 || material == 11) return paint_hair(p);
    if (material == 4) return paint_shoe(p);
    if (material == 5) return paint_sole(p);
    if (material == 6) return paint_shorts(p);
    if (material == 7) return paint_jacket(p);
    if (material == 9) return paint_blouse(p);
    if (material == 10) return paint_skirt(p);
    return paint_long_hair(p);
}

void main() {
    if (cut(v_rest)) discard;
    vec3 linear_colour = pow(clamp(paint(v_rest), 0.0, 1.0), vec3(2.2));
    vec3 to_eye = normalize(eye - v_position);
    vec3 normal = normalize(v_normal);
    vec3 flat_normal = cross(dFdx(v_position), dFdy(v_position));
    if (dot(flat_normal, to_eye) < 0.0) flat_normal = -flat_normal;
    bool inside = dot(flat_normal, normal) < 0.0;
    if (dot(normal, to_eye) < 0.0) normal = -normal;
    vec3 lamp = normalize(transpose(mat3(view)) * vec3(0.25, 0.45, 1.0));
    float lit = 0.40 + 0.62 * pow(0.5 + 0.5 * dot(normal, lamp), 1.5);
    float shade = lit * mix(0.45, 1.0, clamp(v_colour.r, 0.0, 1.0));
    pixel = vec4(linear_colour * shade * (inside ? 0.45 : 1.0), 1.0);
}
