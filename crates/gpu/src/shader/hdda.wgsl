// The walk with a body given when the shader is made: what to do at each step and in empty space, and the layer at which to
// stop. Capitals behind a dollar sign are put in from Rust: nuage_gpu::hdda, which says what a body sees.

fn $NAME(field: u32, ray: LocalRay, begin: f32, end: f32, state: ptr<function, $STATE>) {
    var accessor = new_accessor();
    var runs = runs_between(field, ray, begin, end);
    let values = values_of(field);
    while (runs.t < runs.t_end) {
        let brick = runs.brick;
        let region = region_at(field, &accessor, brick);
        let t0 = runs.t;
        pass_region(&runs, region);
        let t1 = min(runs.t, runs.t_end);
        let tag = tag_of(region.entry);
        if (tag == ABSENT_TAG) {
            $EMPTY
            if (!HAS_MAPS && region.log2_bricks == LOG2_NODE5_BRICKS) {
                leap_to_root_entry(&runs);
            }
            continue;
        }
        if (t0 >= t1) {
            continue;
        }
        let corner = corner_of(field, brick);
        let words = brick_of(values, region.entry);
        if ($LAYER == BRICK_LAYER || tag == CONSTANT_TAG) {
            let cell = cells_between(ray, t0, t1, corner).packed;
            // Bricks have no value of their own.
            let value = select(0.0, meant(field, bitcast<f32>(region.entry.payload)), tag == CONSTANT_TAG);
            $STEP
            continue;
        }
        var cells = cells_between(ray, t0, t1, corner);
        while (cells.t < t1) {
            let here = next_cell(&cells);
            let cell = here.packed;
            let value = brick_value(field, values, words, offset_of(cell));
            let t0 = here.t0;
            let t1 = here.t1;
            $STEP
        }
    }
}
