// Voxels of a list put into a dense array of densities. Of several at one place the densest counts, in whatever order they come.

// As `crate::build::Scatter`.
struct Scatter {
    // Voxels along each axis, and what values mean.
    size: vec4<u32>,
    // How many voxels there are in the list, and a level set's band.
    count: vec4<u32>,
}

@group(0) @binding(0) var<uniform> list: Scatter;
// Three indices and the bits of a value.
@group(0) @binding(1) var<storage, read> voxels: array<vec4<u32>>;
@group(0) @binding(2) var<storage, read_write> dense: array<atomic<u32>>;

@compute @workgroup_size(LANES)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * LANES + id.x;
    if (i >= list.count.x) {
        return;
    }
    let voxel = voxels[i];
    // Negative indices are beyond any size.
    if (any(voxel.xyz >= list.size.xyz)) {
        return;
    }
    let at = (voxel.x * list.size.y + voxel.y) * list.size.z + voxel.z;
    atomicMax(&dense[at], density(voxel.w, list.size.w, list.count.y));
}
