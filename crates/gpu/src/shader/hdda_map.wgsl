// The walk with a body given when the shader is made, through the field's map: what hdda.wgsl does through the tree. Bricks are
// counted from the field's base brick, where the map begins. A brick is left by its faces, not by adding up: nothing but the
// brick and the distance is carried from one to the next, which keeps registers few.

fn $NAME(field: u32, ray: LocalRay, begin: f32, end: f32, state: ptr<function, $STATE>) {
    count_ray();
    let values = values_of(field);
    let base = fields[field].base_brick.xyz;
    let last_brick = fields[field].box_last.xyz - base;
    let map = u32(fields[field].box_last.w);
    let row = last_brick.z + 2;
    let layer = (last_brick.y + 2) * row;
    let is_still = ray.direction == vec3<f32>(0.0);
    let forward = ray.direction >= vec3<f32>(0.0);
    let ahead = select(vec3<f32>(-1.0), vec3<f32>(1.0), forward);
    let face = select(vec3<f32>(0.0), vec3<f32>(BRICK_SIDE), forward);
    // Where the ray is in the planes through the first corner; in those along it, never.
    let plane = select(-ray.origin * ray.inverse, vec3<f32>(MAX_F32), is_still);
    var t = begin;
    var next_brick = vec3<f32>(clamp(vec3<i32>(floor(ray_at(ray, t) / BRICK_SIDE)), vec3<i32>(1), last_brick));
    loop {
        count_region();
        let local = next_brick;
        // Converted here, since registers for numbers of one ray are dearer than those for numbers of all.
        let last = vec3<f32>(last_brick);
        // No map has more cells than single precision counts.
        let at = map + MAP_CELL_WORDS * u32(local.x * f32(layer) + (local.y * f32(row) + local.z));
        let kind = tree[at];
        let is_absent = (kind & 0xffu) == ABSENT_TAG;
        // What is as empty all around.
        let margin = select(0.0, f32(kind >> 8u) - 1.0, is_absent);
        let corner = local * BRICK_SIDE;
        let faces = (corner + face + ahead * (margin * BRICK_SIDE)) * ray.inverse + plane;
        let leaves = min_component(faces);
        let is_x = faces.x <= leaves;
        let is_y = !is_x && faces.y <= leaves;
        let t0 = t;
        let t1 = min(max(t0, leaves), end);
        let within = clamp(floor(ray_at(ray, t1) / BRICK_SIDE), max(local - margin, vec3<f32>(1.0)), min(local + margin, last));
        next_brick = select(within, local + ahead * (margin + 1.0), vec3<bool>(is_x, is_y, !(is_x || is_y)));
        t = select(t1, end, any(next_brick < vec3<f32>(1.0)) || any(next_brick > last));
        // One branch and no `continue`: in software each costs as much as a voxel.
        if (is_absent) {
            $EMPTY
        } else {
            let brick = vec3<i32>(local) + base;
            let words = brick_of(values, Entry(tree[at + 1u], kind));
            var cells = cells_between(ray, t0, t1, corner);
            if ($LAYER == BRICK_LAYER) {
                let cell = cells.packed;
                let value = 0.0;
                $STEP
            } else {
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
        // Not at the loop's head: software goes through the body once more else, with nothing in it.
        if (!(t < end)) {
            break;
        }
    }
}
