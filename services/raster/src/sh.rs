//! Real spherical harmonics of degree 0 to 3 in the order and signs of INRIA's files.

use segwild_scene::ply::SH0;

const C1: f32 = 0.488_602_51;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_33, -0.457_045_8, 1.445_305_7, -0.590_043_6];

/// Values of the basis functions in a unit direction; the first `(degree + 1)²` are set.
pub fn basis(degree: u32, [x, y, z]: [f32; 3]) -> [f32; 16] {
    let mut b = [0.0; 16];
    b[0] = SH0;
    if degree >= 1 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree >= 3 {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    b
}

/// Gradient with respect to the direction, from the gradients with respect to the basis functions' values.
pub fn basis_backward(degree: u32, [x, y, z]: [f32; 3], g: &[f32; 16]) -> [f32; 3] {
    let mut d = [0.0; 3];
    if degree >= 1 {
        d[1] -= C1 * g[1];
        d[2] += C1 * g[2];
        d[0] -= C1 * g[3];
    }
    if degree >= 2 {
        d[0] += C2[0] * y * g[4] - 2.0 * C2[2] * x * g[6] + C2[3] * z * g[7] + 2.0 * C2[4] * x * g[8];
        d[1] += C2[0] * x * g[4] + C2[1] * z * g[5] - 2.0 * C2[2] * y * g[6] - 2.0 * C2[4] * y * g[8];
        d[2] += C2[1] * y * g[5] + 4.0 * C2[2] * z * g[6] + C2[3] * x * g[7];
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        d[0] += C3[0] * 6.0 * x * y * g[9] + C3[1] * y * z * g[10]
            - C3[2] * 2.0 * x * y * g[11]
            - C3[3] * 6.0 * x * z * g[12]
            + C3[4] * (4.0 * zz - 3.0 * xx - yy) * g[13]
            + C3[5] * 2.0 * x * z * g[14]
            + C3[6] * 3.0 * (xx - yy) * g[15];
        d[1] += C3[0] * 3.0 * (xx - yy) * g[9]
            + C3[1] * x * z * g[10]
            + C3[2] * (4.0 * zz - xx - 3.0 * yy) * g[11]
            - C3[3] * 6.0 * y * z * g[12]
            - C3[4] * 2.0 * x * y * g[13]
            - C3[5] * 2.0 * y * z * g[14]
            - C3[6] * 6.0 * x * y * g[15];
        d[2] += C3[1] * x * y * g[10]
            + C3[2] * 8.0 * y * z * g[11]
            + C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12]
            + C3[4] * 8.0 * x * z * g[13]
            + C3[5] * (xx - yy) * g[14];
    }
    d
}
