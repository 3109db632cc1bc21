// NanoVDB's side of gpu_vs_pnanovdb.sh: kernels over the rays of one picture, on what PNanoVDB.h offers to shaders.
//
// KERNEL is one of
//
//   SURFACE          the distance of the first change of sign, by pnanovdb_hdda_zero_crossing; -1 if there is none
//   NEAREST_BOX      opacity by a look-up every half voxel in the whole box, through the accessor
//   NEAREST_SPANS    the same, only where there are leaves, which the HDDA finds, with addresses in a leaf by arithmetic alone
//   NEAREST_WALK     the same again, with a walk of our own in place of the HDDA: by the faces of cubes, from where the last was left
//   TRILINEAR_SPANS  as NEAREST_SPANS with interpolated values, through the accessor
//
// Rays live in index space, as those of nanovdb_rays.cc: pinhole, one ray through each pixel's centre.
#version 450
#extension GL_GOOGLE_include_directive : require

#define PNANOVDB_GLSL
#define SURFACE 0
#define NEAREST_BOX 1
#define NEAREST_SPANS 2
#define NEAREST_WALK 3
#define TRILINEAR_SPANS 4

layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, set = 0, binding = 0) readonly buffer Grid { uint pnanovdb_buf_data[]; };
layout(std430, set = 0, binding = 1) writeonly buffer Picture { vec4 picture[]; };
// The eye, and the tangent of half the field of view; the picture's side, the step, and the extinction of value 1 per voxel.
layout(std140, set = 0, binding = 2) uniform View { vec4 eye; vec4 view; };

#include "PNanoVDB.h"

const uint TYPE = PNANOVDB_GRID_TYPE_FLOAT;
const float MANY = 1e9;
// How far behind a face a ray is looked for, in voxels.
const float NUDGE = 1e-3;

pnanovdb_buf_t buf;

float value_at(inout pnanovdb_readaccessor_t accessor, vec3 p)
{
    ivec3 ijk = ivec3(floor(p));
    return pnanovdb_read_float(buf, pnanovdb_readaccessor_get_value_address(TYPE, buf, accessor, ijk));
}

float interpolated(inout pnanovdb_readaccessor_t accessor, vec3 p)
{
    vec3 corner = floor(p), f = p - corner;
    ivec3 ijk = ivec3(corner);
    float c[8];
    for (int i = 0; i < 8; ++i) {
        ivec3 at = ijk + ivec3(i >> 2, (i >> 1) & 1, i & 1);
        c[i] = pnanovdb_read_float(buf, pnanovdb_readaccessor_get_value_address(TYPE, buf, accessor, at));
    }
    vec4 across = mix(vec4(c[0], c[1], c[2], c[3]), vec4(c[4], c[5], c[6], c[7]), f.x);
    vec2 along = mix(across.xy, across.zw, f.y);
    return mix(along.x, along.y, f.z);
}

// The samples of the nearest voxels of the leaf that is cached, up to where a ray leaves it.
void pass_leaf(inout pnanovdb_readaccessor_t accessor, vec3 origin, vec3 direction, float stride, float loss, float leaves,
    inout float k, inout float transmittance)
{
    const uint base = pnanovdb_leaf_get_table_address(TYPE, buf, accessor.leaf, 0).byte_offset;
    for (; k * stride < leaves; k += 1) {
        pnanovdb_coord_t at = ivec3(floor(origin + direction * (k * stride)));
        pnanovdb_address_t address;
        address.byte_offset = base + 4 * pnanovdb_leaf_coord_to_offset(at);
        transmittance *= 1 - loss * pnanovdb_read_float(buf, address);
    }
}

void main()
{
    const uvec2 pixel = gl_GlobalInvocationID.xy;
    const uint side = uint(view.x);
    if (pixel.x >= side || pixel.y >= side) return;
    const vec2 centre = 2 * (vec2(pixel) + 0.5) / view.x - 1;
    const vec3 origin = eye.xyz, direction = normalize(vec3(centre.x * eye.w, -centre.y * eye.w, -1));
    const float stride = view.y, loss = view.z * stride;

    pnanovdb_grid_handle_t grid;
    grid.address = pnanovdb_address_null();
    const pnanovdb_tree_handle_t tree = pnanovdb_grid_get_tree(buf, grid);
    const pnanovdb_root_handle_t root = pnanovdb_tree_get_root(buf, tree);
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(accessor, root);

    vec4 result = vec4(0);
#if KERNEL == SURFACE
    float hit = 0, value = 0;
    bool is_hit = pnanovdb_hdda_zero_crossing(TYPE, buf, accessor, origin, 0, direction, MANY, hit, value);
    result.x = is_hit ? hit : -1;
#else
    const vec3 low = vec3(pnanovdb_root_get_bbox_min(buf, root)), high = vec3(pnanovdb_root_get_bbox_max(buf, root)) + 1;
    float t0 = 0, t1 = MANY, transmittance = 1;
    if (pnanovdb_hdda_ray_clip(low, high, origin, t0, direction, t1)) {
#if KERNEL == NEAREST_BOX
        for (float k = ceil(t0 / stride); k * stride < t1; k += 1)
            transmittance *= 1 - loss * value_at(accessor, origin + direction * (k * stride));
#elif KERNEL == NEAREST_WALK
        const vec3 inverse = 1 / direction;
        float t = t0, k = ceil(t0 / stride);
        while (t < t1) {
            const ivec3 ijk = ivec3(floor(origin + direction * (t + NUDGE)));
            const int dim = max(8, int(pnanovdb_readaccessor_get_dim(TYPE, buf, accessor, ijk)));
            const vec3 corner = vec3(ijk & ~(dim - 1));
            const vec3 faces = (corner + mix(vec3(0), vec3(dim), greaterThan(direction, vec3(0))) - origin) * inverse;
            t = max(t + NUDGE, min(faces.x, min(faces.y, faces.z)));
            const float leaves = min(t, t1);
            if (dim == 8 && pnanovdb_readaccessor_iscached0(accessor, pnanovdb_readaccessor_computedirty(accessor, ijk)))
                pass_leaf(accessor, origin, direction, stride, loss, leaves, k, transmittance);
            k = ceil(leaves / stride);
        }
#else
        ivec3 ijk = ivec3(floor(origin + direction * t0));
        pnanovdb_hdda_t hdda;
        // Bricks are the finest step: below them samples follow their own lattice.
        uint dim = max(8u, pnanovdb_readaccessor_get_dim(TYPE, buf, accessor, ijk));
        pnanovdb_hdda_init(hdda, origin, t0, direction, t1, int(dim));
        float k = ceil(t0 / stride);
        bool is_inside = true;
        while (is_inside) {
            const bool is_leaf = hdda.dim == 8 && pnanovdb_readaccessor_iscached0(accessor,
                pnanovdb_readaccessor_computedirty(accessor, hdda.voxel));
            is_inside = pnanovdb_hdda_step(hdda);
            const float leaves = min(hdda.tmin, t1);
            if (is_leaf) {
#if KERNEL == NEAREST_SPANS
                pass_leaf(accessor, origin, direction, stride, loss, leaves, k, transmittance);
#else
                for (; k * stride < leaves; k += 1)
                    transmittance *= 1 - loss * interpolated(accessor, origin + direction * (k * stride));
#endif
            }
            k = ceil(leaves / stride);
            if (is_inside) {
                ijk = ivec3(floor(origin + direction * (hdda.tmin + NUDGE)));
                dim = max(8u, pnanovdb_readaccessor_get_dim(TYPE, buf, accessor, ijk));
                pnanovdb_hdda_update(hdda, origin, direction, int(dim));
                if (hdda.dim == 8) hdda.voxel = ijk & ~7;
            }
        }
#endif
    }
    result.x = 1 - transmittance;
#endif
    picture[pixel.y * side + pixel.x] = result;
}
