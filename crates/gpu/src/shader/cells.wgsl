// The cells of a brick that a ray passes: the innermost level of the walk.

// A cell of a brick is one word: in the lower bits the number of its voxel, a brick further on, above them each coordinate, 8 more
// than it is, in five bits. A step is one addition, and one beyond the brick shows in bits that no cell within has set or cleared.
const CELL_NUMBER: u32 = 0x1ffu;
const CELL_ORIGIN: u32 = 0x200u | (0x108u << 11u) | (0x8u << 21u);
const CELL_OUTSIDE: u32 = (0x318u << 11u) | (0x18u << 21u);
const CELL_STEPS: vec3<u32> = vec3<u32>((1u << 21u) + 64u, (1u << 16u) + 8u, (1u << 11u) + 1u);

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

// As voxels of a brick are numbered.
fn offset_of(packed: u32) -> u32 {
    return packed & CELL_NUMBER;
}

// Counted from the brick's first.
fn local_of(packed: u32) -> vec3<i32> {
    return vec3<i32>((vec3<u32>(packed) >> vec3<u32>(6u, 3u, 0u)) & vec3<u32>(7u));
}

// The cells between two distances in the brick whose first voxel is at a position.
fn cells_between(ray: LocalRay, t0: f32, t1: f32, corner: vec3<f32>) -> Cells {
    let forward = ray.direction >= vec3<f32>(0.0);
    let inside = ray_at(ray, t0) - corner;
    let local = clamp(floor(inside), vec3<f32>(0.0), vec3<f32>(BRICK_SIDE - 1.0));
    let faces = corner + local + select(vec3<f32>(0.0), vec3<f32>(1.0), forward);
    let t = (faces - ray.origin) * ray.inverse;
    let is_still = ray.direction == vec3<f32>(0.0);
    let steps = vec3<u32>(local) * CELL_STEPS;
    return Cells(
        CELL_ORIGIN + steps.x + steps.y + steps.z,
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
    let is_last = (stepped & CELL_OUTSIDE) != (CELL_ORIGIN & CELL_OUTSIDE);
    let t1 = select(min(max(t0, leaves), (*cells).end), (*cells).end, is_last);
    (*cells).t = t1;
    (*cells).packed = stepped;
    (*cells).t_next = next + select(vec3<f32>(0.0), (*cells).t_cell, vec3<bool>(is_x, is_y, is_z));
    return Cell(packed, t0, t1);
}
