// Rays that nothing stands in the way of.

fn end_of(pixel: vec2<u32>, ray: Ray) -> f32 {
    return MAX_F32;
}
