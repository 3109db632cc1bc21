// What passes read and write. Structures have the layout of their twins in Rust (`crate::params`).

struct Field {
    // Columns of the matrix that takes directions of the world to positions of the field.
    x_axis: vec4<f32>,
    y_axis: vec4<f32>,
    z_axis: vec4<f32>,
    // The position of the volume's origin; then the unit of half floats in bricks.
    origin: vec4<f32>,
    // Where samples can be other than 0; then the unit of bounds, and the smallest value.
    bounds_min: vec4<f32>,
    bounds_max: vec4<f32>,
    // The brick that positions count from; then the first root cell.
    base_brick: vec4<i32>,
    // The first and the last brick that matter; then, in the first, the count of root cells.
    box_first: vec4<i32>,
    box_last: vec4<i32>,
    // The first and the last active voxel.
    active_min: vec4<i32>,
    active_max: vec4<i32>,
    // What values mean: scale, bias, and the largest.
    value: vec4<f32>,
    // What is added to an index for the source's.
    index_offset: vec4<i32>,
}

struct Light {
    // A direction to it, or its place; then its kind.
    place: vec4<f32>,
    // Irradiance, intensity or radiance; then a cone's spread, the cosine of the inner angle, or the radius.
    colour: vec4<f32>,
    // Where a spot shines; then the cosine of the outer angle.
    aim: vec4<f32>,
}

struct Medium {
    // Extinction of the three colours, and the largest of them.
    extinction: vec4<f32>,
    albedo: vec4<f32>,
    phase: Phase,
    // Radiance per value, then -1; or a black body's scale in the first, then kelvin per unit.
    emission: vec4<f32>,
    // What it is, the channel of its densities, that which rays of scattered light read, and that which glows: NONE if
    // nothing does, SOLID_CHANNEL if a solid does itself.
    kind: vec4<u32>,
    // Rows of what takes the world to a solid's unit cube or ball.
    unit_x: vec4<f32>,
    unit_y: vec4<f32>,
    unit_z: vec4<f32>,
}

struct Params {
    camera: vec4<f32>,
    forward: vec4<f32>,
    right: vec4<f32>,
    up: vec4<f32>,
    // Width, height, frame, first sample.
    size: vec4<u32>,
    // Samples, most scatterings, what a view shows, lights.
    counts: vec4<u32>,
    sky_up: vec4<f32>,
    sky_zenith: vec4<f32>,
    sky_horizon: vec4<f32>,
    sky_ground: vec4<f32>,
    // Step of camera rays and of shadow rays in voxels, growth, least transmittance.
    march: vec4<f32>,
    // Rays to the sun and to the sky, the depth at which shadow rays end, the step of the light volume in voxels.
    march_rays: vec4<f32>,
    sun_direction: vec4<f32>,
    sun_irradiance: vec4<f32>,
    // The nearest and the furthest distance, the largest value, the surface's level.
    view: vec4<f32>,
    // Exposure, one over the samples, pixels of the picture per pixel of the target.
    tone: vec4<f32>,
    // Columns of what takes the host's clip space to the world.
    clip_x: vec4<f32>,
    clip_y: vec4<f32>,
    clip_z: vec4<f32>,
    clip_w: vec4<f32>,
    // Width and height of what is marched, pixels of the picture along each side of one of its pixels, and the number of the
    // picture.
    marched: vec4<u32>,
    // In positions of the field that shadow rays meet: the node of the light volume nearest to the sun, and the way to the next node along
    // each of its axes; last, the world length of that away from the sun.
    light_first: vec4<f32>,
    light_x: vec4<f32>,
    light_y: vec4<f32>,
    light_z: vec4<f32>,
    // Rows of what takes positions of that field to coordinates of the light volume.
    light_u: vec4<f32>,
    light_v: vec4<f32>,
    light_w: vec4<f32>,
    // The camera of the picture before.
    before_camera: vec4<f32>,
    before_forward: vec4<f32>,
    before_right: vec4<f32>,
    before_up: vec4<f32>,
    // The most pictures that a mean counts as, whether colours before are clamped, whether the camera moved.
    history: vec4<f32>,
    // Rows of what takes the world to the map of the sky, and its width and height; then how many turns a loop takes that is to
    // tell whether loops take all of theirs.
    map_x: vec4<f32>,
    map_y: vec4<f32>,
    map_z: vec4<f32>,
    map_size: vec4<u32>,
    // Of a band of pixels the first and how many there are, the look-ups of each in one dispatch, and the most shadow rays or
    // scatterings of a pixel in a picture's first.
    rounds: vec4<u32>,
    media: array<Medium, MAX_MEDIA>,
    lights: array<Light, MAX_LIGHTS>,
    // Of black bodies by their temperature: colour of luminance 1, and the logarithm of the luminance.
    blackbody: array<vec4<f32>, BLACKBODY_ROWS>,
}

@group(0) @binding(0) var<storage, read> tree: array<u32>;
@group(0) @binding(1) var<storage, read> fields: array<Field>;
@group(0) @binding(2) var<storage, read> tables: array<u32>;
@group(1) @binding(0) var<uniform> params: Params;
