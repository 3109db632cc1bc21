// All texels of a texture of blocks, as compute shaders read them.

@group(0) @binding(0) var blocks: texture_3d<f32>;
@group(0) @binding(1) var<storage, read_write> texels: array<vec4<f32>>;

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn probe(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(blocks);
    if (all(id < size)) {
        texels[(id.z * size.y + id.y) * size.x + id.x] = textureLoad(blocks, id, 0);
    }
}
