// From the sums over pixels to the gradients of the parameters (twin: `Projector::backward` in raster/src/cpu/project.rs, fed by
// `sum_slots`). One thread per splat.
#import common
#import view
#import path

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> means: array<vec4f>;
@group(0) @binding(3) var<storage, read> log_scales: array<vec4f>;
@group(0) @binding(4) var<storage, read> rotations: array<vec4f>;
@group(0) @binding(5) var<storage, read> slots: array<vec2u>;
@group(0) @binding(6) var<storage, read> moments: array<vec4f>;
// Four vec4 per splat: mean and opacity; log scale and screen; rotation; absolute screen and nothing.
@group(0) @binding(7) var<storage, read_write> grads: array<vec4f>;

fn kept(x: f32) -> f32 {
    return select(0.0, x, finite(x));
}

fn kept3(v: vec3f) -> vec3f {
    return vec3f(kept(v.x), kept(v.y), kept(v.z));
}

@compute @workgroup_size(64)
fn project_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 64u + local;
    if i >= job.x {
        return;
    }
    for (var k = 0u; k < 4u; k += 1u) {
        grads[4u * i + k] = vec4f(0.0);
    }
    let own = slots[i];
    if own.y == 0u {
        return;
    }
    var m0 = vec4f(0.0);
    var m1 = vec4f(0.0);
    for (var k = own.x; k < own.x + own.y; k += 1u) {
        m0 += moments[2u * k];
        m1 += moments[2u * k + 1u];
    }
    let p = path_of(view, means[i], log_scales[i].xyz, rotations[i]);
    if !p.good {
        return;
    }
    let g_u = m0.y;
    let g_uu = m0.z;
    let g_y = m0.w;
    let a = p.syy / p.det;
    let e = 1.0 / p.syy;
    let r = p.sxy / p.syy;

    // ln alpha = ln o - q/2 with q = a u² + e dy².
    let gx = a * g_u;
    let gy = e * g_y - a * r * g_u;
    let dv = 0.5 * a * a * g_uu;
    let dr = a * m1.x;
    var dxx = dv;
    var dxy = e * dr - 2.0 * r * dv;
    var dyy = r * r * dv - r * e * dr + 0.5 * e * e * m1.y;
    if view.options.y > 0.0 && p.det0 > 0.0 {
        let low_pass = view.options.x;
        let i0 = 1.0 / p.det0;
        let i1 = 1.0 / p.det;
        let h = 0.5 * m0.x;
        dxx += h * ((p.syy - low_pass) * i0 - p.syy * i1);
        dyy += h * ((p.sxx - low_pass) * i0 - p.sxx * i1);
        dxy += h * 2.0 * p.sxy * (i1 - i0);
    }
    let dm_x = 2.0 * dxx * p.m_x + dxy * p.m_y;
    let dm_y = 2.0 * dyy * p.m_y + dxy * p.m_x;

    // M = (J W) (R S).
    let rs_0 = p.rot_0 * p.scale;
    let rs_1 = p.rot_1 * p.scale;
    let rs_2 = p.rot_2 * p.scale;
    let djw_x = vec3f(dot(dm_x, rs_0), dot(dm_x, rs_1), dot(dm_x, rs_2));
    let djw_y = vec3f(dot(dm_y, rs_0), dot(dm_y, rs_1), dot(dm_y, rs_2));
    let drs_0 = p.jw_x.x * dm_x + p.jw_y.x * dm_y;
    let drs_1 = p.jw_x.y * dm_x + p.jw_y.y * dm_y;
    let drs_2 = p.jw_x.z * dm_x + p.jw_y.z * dm_y;
    let log_scale = drs_0 * rs_0 + drs_1 * rs_1 + drs_2 * rs_2;
    let d0 = drs_0 * p.scale;
    let d1 = drs_1 * p.scale;
    let d2 = drs_2 * p.scale;

    let inv_z = 1.0 / p.cam.z;
    let jx = view.lens.x * inv_z;
    let jy = view.lens.y * inv_z;
    // Row r of J W is j_r (W_r - tan_r W_z).
    let dtan_x = -jx * dot(djw_x, view.row_z.xyz);
    let dtan_y = -jy * dot(djw_y, view.row_z.xyz);
    var dcam = vec3f(jx * gx, jy * gy, 0.0);
    let tx = p.cam.x * inv_z;
    let ty = p.cam.y * inv_z;
    dcam.z -= jx * tx * gx + jy * ty * gy;
    dcam.z -= inv_z * (dot(djw_x, p.jw_x) + dot(djw_y, p.jw_y));
    if !p.clamped_x {
        dcam.x += dtan_x * inv_z;
        dcam.z -= dtan_x * tx * inv_z;
    }
    if !p.clamped_y {
        dcam.y += dtan_y * inv_z;
        dcam.z -= dtan_y * ty * inv_z;
    }
    let mean = view.row_x.xyz * dcam.x + view.row_y.xyz * dcam.y + view.row_z.xyz * dcam.z;

    let qw = p.quat.x;
    let qx = p.quat.y;
    let qy = p.quat.z;
    let qz = p.quat.w;
    let dq = vec4f(
        2.0 * (qx * (d2.y - d1.z) + qy * (d0.z - d2.x) + qz * (d1.x - d0.y)),
        2.0 * (qy * (d0.y + d1.x) + qz * (d0.z + d2.x) + qw * (d2.y - d1.z) - 2.0 * qx * (d1.y + d2.z)),
        2.0 * (qx * (d0.y + d1.x) + qz * (d1.z + d2.y) + qw * (d0.z - d2.x) - 2.0 * qy * (d0.x + d2.z)),
        2.0 * (qx * (d0.z + d2.x) + qy * (d1.z + d2.y) + qw * (d1.x - d0.y) - 2.0 * qz * (d0.x + d1.y)),
    );
    let rotation = (dq - p.quat * dot(dq, p.quat)) * p.inv_norm;

    let half_size = 0.5 * vec2f(view.frame.xy);
    let screen = length(vec2f(gx, gy) * half_size);
    let screen_abs = length(m1.zw * half_size);
    grads[4u * i] = vec4f(kept3(mean), kept(m0.x * (1.0 - p.sigmoid)));
    grads[4u * i + 1u] = vec4f(kept3(log_scale), kept(screen));
    grads[4u * i + 2u] = vec4f(kept3(rotation.xyz), kept(rotation.w));
    grads[4u * i + 3u] = vec4f(kept(screen_abs), 0.0, 0.0, 0.0);
}
