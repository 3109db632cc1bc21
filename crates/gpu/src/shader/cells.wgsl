// The cells of a brick that a ray passes: the innermost level of the walk.

struct Cells {
    local: vec3<i32>,
    t: f32,
    end: f32,
    t_next: vec3<f32>,
    t_cell: vec3<f32>,
    sign: vec3<i32>,
}

// A cell, counted from the brick's first, and where the ray is in it.
struct Cell { local: vec3<i32>, t0: f32, t1: f32 }

// The cells between two distances in the brick whose first voxel is at a position.
fn cells_between(ray: LocalRay, t0: f32, t1: f32, corner: vec3<f32>) -> Cells {
    let forward = ray.direction >= vec3<f32>(0.0);
    let inside = ray_at(ray, t0) - corner;
    let local = clamp(vec3<i32>(floor(inside)), vec3<i32>(0), vec3<i32>(7));
    let faces = corner + vec3<f32>(select(local, local + 1, forward));
    let t = (faces - ray.origin) * ray.inverse;
    let is_still = ray.direction == vec3<f32>(0.0);
    return Cells(
        local, t0, t1, select(t, vec3<f32>(MAX_F32), is_still), abs(ray.inverse),
        select(vec3<i32>(-1), vec3<i32>(1), forward),
    );
}

fn next_cell(cells: ptr<function, Cells>) -> Cell {
    let next = (*cells).t_next;
    let t0 = (*cells).t;
    let local = (*cells).local;
    var axis = vec3<i32>(0, 0, 1);
    if (next.x <= next.y && next.x <= next.z) {
        axis = vec3<i32>(1, 0, 0);
    } else if (next.y <= next.z) {
        axis = vec3<i32>(0, 1, 0);
    }
    let stepped = local + axis * (*cells).sign;
    // Beyond the brick's last cell the brick ends, whatever rounding says.
    let is_last = any(stepped < vec3<i32>(0)) || any(stepped > vec3<i32>(7));
    let t1 = select(min(max(t0, min_component(next)), (*cells).end), (*cells).end, is_last);
    (*cells).t = t1;
    (*cells).local = select(stepped, local, is_last);
    (*cells).t_next = next + select(vec3<f32>(0.0), (*cells).t_cell, axis == vec3<i32>(1));
    return Cell(local, t0, t1);
}

// The voxel in which a ray enters a region.
fn cell_in(brick: vec3<i32>, region: Region, field: u32, ray: LocalRay, t: f32) -> vec3<i32> {
    let corner = vec3<f32>(brick - fields[field].base_brick.xyz) * BRICK_SIDE;
    let local = clamp(vec3<i32>(floor(ray_at(ray, t) - corner)), vec3<i32>(0), vec3<i32>(7));
    return (brick << vec3<u32>(LOG2_BRICK)) + local;
}
