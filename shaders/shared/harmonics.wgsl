// Real spherical harmonics of degree 0 to 3 (twin: raster/src/sh.rs), the eye, and the direction from it to a splat.
const C0: f32 = 0.28209479;
const C1: f32 = 0.48860251;
const C2: vec3f = vec3f(1.0925485, 0.31539157, 0.54627421);
const C3: vec4f = vec4f(0.59004360, 2.8906114, 0.45704580, 0.37317633);
const C3_5: f32 = 1.4453057;

// Unit direction and one over the distance; where there is none, straight on and 0.
fn direction_to(view: View, mean: vec3f) -> vec4f {
    let eye = -(view.row_x.xyz * view.row_x.w + view.row_y.xyz * view.row_y.w + view.row_z.xyz * view.row_z.w);
    let d = mean - eye;
    let square = dot(d, d);
    let inverse = 1.0 / sqrt(square);
    if square > 0.0 && finite(square) && finite(inverse) {
        return vec4f(d * inverse, inverse);
    }
    return vec4f(0.0, 0.0, 1.0, 0.0);
}

// Values of the basis functions in a unit direction; the first (degree + 1)² are set.
fn basis(degree: u32, d: vec3f) -> array<f32, 16> {
    var b: array<f32, 16>;
    let x = d.x;
    let y = d.y;
    let z = d.z;
    b[0] = C0;
    if degree >= 1u {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    if degree >= 2u {
        b[4] = C2.x * x * y;
        b[5] = -C2.x * y * z;
        b[6] = C2.y * (2.0 * zz - xx - yy);
        b[7] = -C2.x * x * z;
        b[8] = C2.z * (xx - yy);
    }
    if degree >= 3u {
        b[9] = -C3.x * y * (3.0 * xx - yy);
        b[10] = C3.y * x * y * z;
        b[11] = -C3.z * y * (4.0 * zz - xx - yy);
        b[12] = C3.w * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = -C3.z * x * (4.0 * zz - xx - yy);
        b[14] = C3_5 * z * (xx - yy);
        b[15] = -C3.x * x * (xx - 3.0 * yy);
    }
    return b;
}

// Gradient with respect to the direction, from those with respect to the basis functions' values.
fn basis_backward(degree: u32, u: vec3f, grads: array<f32, 16>) -> vec3f {
    var g = grads;
    var d = vec3f(0.0);
    let x = u.x;
    let y = u.y;
    let z = u.z;
    if degree >= 1u {
        d += C1 * vec3f(-g[3], -g[1], g[2]);
    }
    if degree >= 2u {
        d.x += C2.x * y * g[4] - 2.0 * C2.y * x * g[6] - C2.x * z * g[7] + 2.0 * C2.z * x * g[8];
        d.y += C2.x * x * g[4] - C2.x * z * g[5] - 2.0 * C2.y * y * g[6] - 2.0 * C2.z * y * g[8];
        d.z += -C2.x * y * g[5] + 4.0 * C2.y * z * g[6] - C2.x * x * g[7];
    }
    if degree >= 3u {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        d.x += -C3.x * 6.0 * x * y * g[9] + C3.y * y * z * g[10] + C3.z * 2.0 * x * y * g[11]
            - C3.w * 6.0 * x * z * g[12] - C3.z * (4.0 * zz - 3.0 * xx - yy) * g[13]
            + C3_5 * 2.0 * x * z * g[14] - C3.x * 3.0 * (xx - yy) * g[15];
        d.y += -C3.x * 3.0 * (xx - yy) * g[9] + C3.y * x * z * g[10]
            - C3.z * (4.0 * zz - xx - 3.0 * yy) * g[11] - C3.w * 6.0 * y * z * g[12]
            + C3.z * 2.0 * x * y * g[13] - C3_5 * 2.0 * y * z * g[14] + C3.x * 6.0 * x * y * g[15];
        d.z += C3.y * x * y * g[10] - C3.z * 8.0 * y * z * g[11]
            + C3.w * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12] - C3.z * 8.0 * x * z * g[13]
            + C3_5 * (xx - yy) * g[14];
    }
    return d;
}
