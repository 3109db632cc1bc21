// The walk with a body given when the shader is made: what to do at each step, in empty space, and the layer at which to
// stop. Capitals behind a dollar sign are put in from Rust; a body sees all names below, and ends the walk by `return`.

fn $NAME(field: u32, ray: LocalRay, begin: f32, end: f32, state: ptr<function, $STATE>) {
    var accessor = new_accessor();
    var runs = runs_between(field, ray, begin, end);
    while (runs.t < runs.t_end) {
        let brick = runs.brick;
        let region = region_at(field, &accessor, brick);
        let t0 = runs.t;
        pass_region(&runs, region.log2_bricks);
        let t1 = min(runs.t, runs.t_end);
        if (tag_of(region.entry) == ABSENT_TAG) {
            $EMPTY
            if (region.log2_bricks == LOG2_NODE5_BRICKS) {
                leap_to_root_entry(&runs);
            }
            continue;
        }
        if (t0 >= t1) {
            continue;
        }
        if ($LAYER == BRICK_LAYER || tag_of(region.entry) == CONSTANT_TAG) {
            let voxel = cell_in(brick, region, field, ray, t0);
            $STEP
            continue;
        }
        var cells = cells_between(ray, t0, t1, vec3<f32>(brick - fields[field].base_brick.xyz) * BRICK_SIDE);
        while (cells.t < t1) {
            let cell = next_cell(&cells);
            if (cell.t0 >= cell.t1) {
                continue;
            }
            let voxel = (brick << vec3<u32>(LOG2_BRICK)) + cell.local;
            let t0 = cell.t0;
            let t1 = cell.t1;
            $STEP
        }
    }
}
