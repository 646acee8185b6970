// Intermediate values of the projection that the backward pass needs too (twin: `Path` in raster/src/cpu/project.rs).
struct Path {
    good: bool,
    cam: vec3f,
    // Whether x/z and y/z were clamped.
    clamped_x: bool,
    clamped_y: bool,
    // Normalised quaternion (w, x, y, z), and one over its norm (0 for one that counts as the identity).
    quat: vec4f,
    inv_norm: f32,
    // Rows of the rotation.
    rot_0: vec3f,
    rot_1: vec3f,
    rot_2: vec3f,
    scale: vec3f,
    // J W and J W R S, 2 x 3.
    jw_x: vec3f,
    jw_y: vec3f,
    m_x: vec3f,
    m_y: vec3f,
    sxx: f32,
    sxy: f32,
    syy: f32,
    det: f32,
    // Determinant before the low-pass.
    det0: f32,
    sigmoid: f32,
}

fn camera_point(view: View, p: vec3f) -> vec3f {
    return vec3f(
        dot(view.row_x.xyz, p) + view.row_x.w,
        dot(view.row_y.xyz, p) + view.row_y.w,
        dot(view.row_z.xyz, p) + view.row_z.w,
    );
}

// `mean.w` is the opacity's logit.
fn path_of(view: View, mean: vec4f, log_scale: vec3f, rotation: vec4f) -> Path {
    var p: Path;
    p.good = false;
    p.cam = camera_point(view, mean.xyz);
    let z = p.cam.z;
    let sane = finite3(p.cam) && finite4(rotation) && finite3(log_scale) && finite(mean.w);
    if !sane || z <= view.options.z || z <= 0.0 {
        return p;
    }
    // Held, so that the exponential stays in range; both ends are 0 and 1 in 32 bits.
    p.sigmoid = 1.0 / (1.0 + exp(-clamp(mean.w, -80.0, 80.0)));
    if p.sigmoid < ALPHA_MIN {
        return p;
    }
    let n2 = dot(rotation, rotation);
    p.inv_norm = 0.0;
    p.quat = vec4f(1.0, 0.0, 0.0, 0.0);
    if n2 > 0.0 && finite(n2) {
        p.inv_norm = 1.0 / sqrt(n2);
        p.quat = rotation * p.inv_norm;
    }
    let w = p.quat.x;
    let x = p.quat.y;
    let y = p.quat.z;
    let u = p.quat.w;
    p.rot_0 = vec3f(1.0 - 2.0 * (y * y + u * u), 2.0 * (x * y - w * u), 2.0 * (x * u + w * y));
    p.rot_1 = vec3f(2.0 * (x * y + w * u), 1.0 - 2.0 * (x * x + u * u), 2.0 * (y * u - w * x));
    p.rot_2 = vec3f(2.0 * (x * u - w * y), 2.0 * (y * u + w * x), 1.0 - 2.0 * (x * x + y * y));
    p.scale = exp(log_scale);

    let inv_z = 1.0 / z;
    let tx = p.cam.x * inv_z;
    let ty = p.cam.y * inv_z;
    let tan_x = clamp(tx, view.limits.x, view.limits.y);
    let tan_y = clamp(ty, view.limits.z, view.limits.w);
    p.clamped_x = tan_x != tx;
    p.clamped_y = tan_y != ty;
    p.jw_x = (view.lens.x * inv_z) * (view.row_x.xyz - tan_x * view.row_z.xyz);
    p.jw_y = (view.lens.y * inv_z) * (view.row_y.xyz - tan_y * view.row_z.xyz);
    p.m_x = (p.jw_x.x * p.rot_0 + p.jw_x.y * p.rot_1 + p.jw_x.z * p.rot_2) * p.scale;
    p.m_y = (p.jw_y.x * p.rot_0 + p.jw_y.y * p.rot_1 + p.jw_y.z * p.rot_2) * p.scale;
    let sxx0 = dot(p.m_x, p.m_x);
    let syy0 = dot(p.m_y, p.m_y);
    p.sxy = dot(p.m_x, p.m_y);
    // Cauchy-Binet: the determinant of M M^T is the sum of the squared minors, which cannot cancel.
    let minors = cross(p.m_x, p.m_y);
    p.det0 = dot(minors, minors);
    let low_pass = view.options.x;
    p.det = p.det0 + low_pass * (sxx0 + syy0) + low_pass * low_pass;
    p.sxx = sxx0 + low_pass;
    p.syy = syy0 + low_pass;
    p.good = finite(p.det) && p.det > 0.0 && p.sxx > 0.0 && p.syy > 0.0 && finite(p.sxy);
    return p;
}

// Opacity after the anti-aliasing compensation.
fn opacity_of(view: View, p: Path) -> f32 {
    if view.options.y > 0.0 {
        return p.sigmoid * sqrt(p.det0 / p.det);
    }
    return p.sigmoid;
}
