// Paths through one grid: what is left of `media.wgsl` where there is nothing else.

// Where a ray collides before `limit`, by delta tracking. What is emitted on the way is added to `light`.
fn fly(
    ray: Ray, limit: f32, is_far: bool, carried: ptr<function, Carried>, light: ptr<function, vec3<f32>>,
    random: ptr<function, Random>,
) -> Collision {
    let field = field_of_medium(0u, is_far);
    let scale = params.media[0].extinction.w;
    let shares = shares_of(0u);
    let span = field_interval(field, in_field(field, ray), 0.0);
    let length = min(span.y, limit) - span.x;
    var told = 0.0;
    var collision = -1.0;
    if (length > 0.0) {
        let local = moved(field, ray, span.x);
        var accessor = new_accessor();
        var runs = runs_between(field, local, 0.0, length);
        var depth = random_depth(random);
        loop {
            let segment = next_segment(&runs, &accessor);
            if (!segment.is_there || collision >= 0.0) {
                break;
            }
            let majorant = segment.max * scale;
            var t = segment.t0;
            loop {
                let left = (segment.t1 - t) * majorant;
                if (has_drawn_enough(random)) {
                    // Bounds far above all values: the ray would not get on.
                    collision = span.x + t;
                    break;
                }
                if (depth >= left) {
                    depth -= left;
                    break;
                }
                t += depth / majorant;
                var part = 1.0;
                if (segment.min != segment.max) {
                    let value = look_up(LOOKUP, field, &accessor, ray_at(local, t), random_3d(random));
                    part = min(value / segment.max, 1.0);
                }
                var is_real: bool;
                if (IS_GREY) {
                    is_real = random_unit(random) < part;
                } else {
                    if (HAS_EMISSION) {
                        *light += (*carried).weight * (*carried).colours * emitted(ray, told, span.x + t, random);
                        told = span.x + t;
                    }
                    is_real = turns(carried, shares * part, random);
                }
                if (is_real) {
                    collision = span.x + t;
                    break;
                }
                depth = random_depth(random);
            }
        }
    }
    if (HAS_EMISSION) {
        let end = select(limit, collision, collision >= 0.0);
        *light += (*carried).weight * (*carried).colours * emitted(ray, told, end, random);
    }
    return Collision(collision, 0u);
}

// A vector whose mean is the share of light that passes along a ray up to a distance.
fn transmittance(ray: Ray, limit: f32, random: ptr<function, Random>) -> vec3<f32> {
    return pass_field(field_of_medium(0u, true), 0u, ray, limit, random);
}
