#version 330
// Linear blend skinning with the K largest weights, K = 4, 8 or 12.
// x_world = (sum_k w_k H_k) [x_rest, 1], H_k a row-major 3x4 skinning matrix.

layout(std140) uniform Joints { vec4 joint_row[3 * JOINTS]; };
uniform mat4 clip_from_world;

in vec3 position;
in vec2 uv;
in uvec4 joint_a;
in vec4 weight_a;
#if K > 4
in uvec4 joint_b;
in vec4 weight_b;
#endif
#if K > 8
in uvec4 joint_c;
in vec4 weight_c;
#endif

#ifdef POSE_FEATURES
layout(std140) uniform PoseFeature { vec4 pose_feature[(POSE_FEATURES + 3) / 4]; };
uniform sampler2D posedirs;
in uint source;
#endif

#ifdef SURFACE
in vec3 normal;
in vec4 colour;
out vec3 v_position;
out vec3 v_normal;
out vec3 v_rest;
out vec4 v_colour;
#endif

out vec2 v_uv;

mat3x4 joint(uint index) {
    uint row = 3u * index;
    return mat3x4(joint_row[row], joint_row[row + 1u], joint_row[row + 2u]);
}

mat3x4 blend(uvec4 index, vec4 weight) {
    return (weight.x * joint(index.x) + weight.y * joint(index.y))
         + (weight.z * joint(index.z) + weight.w * joint(index.w));
}

mat3x4 skin() {
    mat3x4 sum = blend(joint_a, weight_a);
#if K > 4
    sum += blend(joint_b, weight_b);
#endif
#if K > 8
    sum += blend(joint_c, weight_c);
#endif
    return sum;
}

vec3 shaped() {
#ifdef POSE_FEATURES
    vec3 offset = vec3(0.0);
    int first = int(source) * POSE_FEATURES;
    for (int i = 0; i < POSE_FEATURES; ++i) {
        int texel = first + i;
        offset += pose_feature[i >> 2][i & 3] * texelFetch(posedirs, ivec2(texel % ROW, texel / ROW), 0).xyz;
    }
    return position + offset;
#else
    return position;
#endif
}

void main() {
    mat3x4 rows = skin();
    vec3 rest = shaped();
    vec3 world = vec4(rest, 1.0) * rows;
    gl_Position = clip_from_world * vec4(world, 1.0);
    v_uv = uv;
#ifdef SURFACE
    v_position = world;
    v_normal = vec4(normal, 0.0) * rows;
    v_rest = rest;
    v_colour = colour;
#endif
}
