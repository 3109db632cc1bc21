// Paths through several media, or solid ones: each has tentative collisions of its own, and the nearest counts.

// The next tentative collision of a ray with one medium.
struct Front {
    // Its distance along the ray; MAX_F32 if there is none.
    next: f32,
    // Of the strongest colour's extinction, the share of which it was made.
    live: f32,
    // What it is in, and where: distances there count from `start`. A solid is a segment of one value, with none behind.
    segment: Segment,
    t: f32,
    start: f32,
    field: u32,
    local: LocalRay,
    runs: Runs,
    accessor: Accessor,
}

// The first tentative collision before `limit`.
fn new_front(
    medium: u32, ray: Ray, limit: f32, is_far: bool, colours: vec3<f32>, random: ptr<function, Random>,
) -> Front {
    var front: Front;
    front.next = MAX_F32;
    front.live = 1.0;
    front.accessor = new_accessor();
    var span: vec2<f32>;
    if (HAS_SOLIDS && params.media[medium].kind.x != SHAPE_GRID) {
        span = solid_interval(medium, ray);
        span.y = min(span.y, limit);
        front.segment = Segment(span.x < span.y, 0.0, span.y - span.x, 1.0, 1.0);
    } else {
        front.field = field_of_medium(medium, is_far);
        span = field_interval(front.field, in_field(front.field, ray), 0.0);
        span.y = min(span.y, limit);
        if (span.x < span.y) {
            front.local = moved(front.field, ray, span.x);
            var runs = runs_between(front.field, front.local, 0.0, span.y - span.x);
            var accessor = front.accessor;
            front.segment = next_segment(&runs, &accessor);
            front.runs = runs;
            front.accessor = accessor;
        }
    }
    front.start = span.x;
    front.t = front.segment.t0;
    if (front.segment.is_there) {
        advance(&front, medium, colours, random);
    }
    return front;
}

// Moves on to the next tentative collision. A colour that the path has no share of needs no majorant.
fn advance(front: ptr<function, Front>, medium: u32, colours: vec3<f32>, random: ptr<function, Random>) {
    if (!IS_GREY) {
        (*front).live = max_component(select(vec3<f32>(0.0), shares_of(medium), colours > vec3<f32>(0.0)));
    }
    let scale = params.media[medium].extinction.w * (*front).live;
    (*front).next = MAX_F32;
    var runs = (*front).runs;
    var accessor = (*front).accessor;
    var segment = (*front).segment;
    var t = (*front).t;
    var depth = random_depth(random);
    loop {
        let majorant = segment.max * scale;
        let left = (segment.t1 - t) * majorant;
        if (depth < left) {
            t += depth / majorant;
            (*front).next = (*front).start + t;
            break;
        }
        depth -= left;
        segment = next_segment(&runs, &accessor);
        if (!segment.is_there) {
            break;
        }
        t = segment.t0;
    }
    (*front).runs = runs;
    (*front).accessor = accessor;
    (*front).segment = segment;
    (*front).t = t;
}

// The density at the tentative collision as a share of the majorant.
fn density_over_majorant(front: ptr<function, Front>, medium: u32, random: ptr<function, Random>) -> f32 {
    let segment = (*front).segment;
    if (segment.min == segment.max || segment.max * params.media[medium].extinction.w * (*front).live > OPAQUE) {
        return 1.0;
    }
    var accessor = (*front).accessor;
    let at = ray_at((*front).local, (*front).t);
    let value = look_up(LOOKUP, (*front).field, &accessor, at, random_3d(random));
    (*front).accessor = accessor;
    return min(value / segment.max, 1.0);
}

// Where a ray collides before `limit`, by delta tracking. What is emitted on the way is added to `light`.
fn fly(
    ray: Ray, limit: f32, is_far: bool, carried: ptr<function, Carried>, light: ptr<function, vec3<f32>>,
    random: ptr<function, Random>,
) -> Collision {
    var fronts: array<Front, MEDIA>;
    for (var i = 0u; i < MEDIA; i++) {
        fronts[i] = new_front(i, ray, limit, is_far, (*carried).colours, random);
    }
    var told = 0.0;
    var collision = Collision(-1.0, 0u);
    loop {
        var nearest_one = 0u;
        var next = fronts[0].next;
        for (var i = 1u; i < MEDIA; i++) {
            if (fronts[i].next < next) {
                nearest_one = i;
                next = fronts[i].next;
            }
        }
        if (next == MAX_F32) {
            break;
        }
        var front = fronts[nearest_one];
        let part = density_over_majorant(&front, nearest_one, random);
        var is_real: bool;
        if (IS_GREY) {
            is_real = random_unit(random) < part;
        } else {
            // What is emitted up to here is worth what the path was worth up to here.
            if (HAS_EMISSION) {
                *light += (*carried).weight * (*carried).colours * emitted(ray, told, next, random);
                told = next;
            }
            let chance = min(shares_of(nearest_one) * (part / front.live), vec3<f32>(1.0));
            is_real = turns(carried, chance, random);
        }
        if (is_real || has_drawn_enough(random)) {
            collision = Collision(next, nearest_one);
            break;
        }
        advance(&front, nearest_one, (*carried).colours, random);
        fronts[nearest_one] = front;
    }
    if (HAS_EMISSION) {
        let end = select(limit, collision.distance, collision.distance >= 0.0);
        *light += (*carried).weight * (*carried).colours * emitted(ray, told, end, random);
    }
    return collision;
}

// A vector whose mean is the share of light that passes along a ray up to a distance.
fn transmittance(ray: Ray, limit: f32, random: ptr<function, Random>) -> vec3<f32> {
    var passes = vec3<f32>(1.0);
    for (var i = 0u; i < MEDIA && any(passes > vec3<f32>(0.0)); i++) {
        if (HAS_SOLIDS && params.media[i].kind.x != SHAPE_GRID) {
            let span = solid_interval(i, ray);
            let length = max(min(span.y, limit) - span.x, 0.0);
            passes *= passing(min(params.media[i].extinction.w * length, MAX_F32), shares_of(i));
        } else {
            passes *= pass_field(field_of_medium(i, true), i, ray, limit, random);
        }
    }
    return passes;
}
