// The cells of a brick that a ray passes: the innermost level of the walk.

// A cell of a brick is one word, x above y above z in bytes, each 16 more than the coordinate: a step beyond the brick shows in
// bits that no cell within has set or cleared.
const CELL_ORIGIN: u32 = 0x101010u;
const CELL_OUTSIDE: u32 = 0x181818u;
const CELL_STEPS: vec3<u32> = vec3<u32>(0x10000u, 0x100u, 1u);

struct Cells {
    packed: u32,
    t: f32,
    end: f32,
    t_next: vec3<f32>,
    t_cell: vec3<f32>,
    step: vec3<u32>,
}

// A cell, and where the ray is in it.
struct Cell { packed: u32, t0: f32, t1: f32 }

// Counted from the brick's first.
fn local_of(packed: u32) -> vec3<i32> {
    return vec3<i32>((vec3<u32>(packed) >> vec3<u32>(16u, 8u, 0u)) & vec3<u32>(7u));
}

// As voxels of a brick are numbered.
fn offset_of(packed: u32) -> u32 {
    return ((packed >> 10u) & 0x1c0u) | ((packed >> 5u) & 0x38u) | (packed & 7u);
}

// The cells between two distances in the brick whose first voxel is at a position.
fn cells_between(ray: LocalRay, t0: f32, t1: f32, corner: vec3<f32>) -> Cells {
    let forward = ray.direction >= vec3<f32>(0.0);
    let inside = ray_at(ray, t0) - corner;
    let local = clamp(floor(inside), vec3<f32>(0.0), vec3<f32>(BRICK_SIDE - 1.0));
    let faces = corner + local + select(vec3<f32>(0.0), vec3<f32>(1.0), forward);
    let t = (faces - ray.origin) * ray.inverse;
    let is_still = ray.direction == vec3<f32>(0.0);
    let bytes = vec3<u32>(local);
    return Cells(
        CELL_ORIGIN + ((bytes.x << 16u) | (bytes.y << 8u) | bytes.z),
        t0, t1, select(t, vec3<f32>(MAX_F32), is_still), abs(ray.inverse),
        select(vec3<u32>(0u) - CELL_STEPS, CELL_STEPS, forward),
    );
}

fn next_cell(cells: ptr<function, Cells>) -> Cell {
    let next = (*cells).t_next;
    let t0 = (*cells).t;
    let packed = (*cells).packed;
    let leaves = min_component(next);
    let is_x = next.x <= leaves;
    let is_y = !is_x && next.y <= leaves;
    let is_z = !(is_x || is_y);
    let step = (*cells).step;
    let stepped = packed + select(select(step.z, step.y, is_y), step.x, is_x);
    // Beyond the brick's last cell the brick ends, whatever rounding says.
    let is_last = (stepped & CELL_OUTSIDE) != CELL_ORIGIN;
    let t1 = select(min(max(t0, leaves), (*cells).end), (*cells).end, is_last);
    (*cells).t = t1;
    (*cells).packed = stepped;
    (*cells).t_next = next + select(vec3<f32>(0.0), (*cells).t_cell, vec3<bool>(is_x, is_y, is_z));
    return Cell(packed, t0, t1);
}
