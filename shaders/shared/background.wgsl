// The background (twins: `direction`, `basis` and `background` in objective/src/background.rs).
fn direction_through(view: View, x: u32, y: u32) -> vec3f {
    let p = vec2f(f32(x) + 0.5, f32(y) + 0.5);
    let ray = (p - view.lens.zw) / view.lens.xy;
    return normalize(ray.x * view.row_x.xyz + ray.y * view.row_y.xyz + view.row_z.xyz);
}

fn sky_basis(d: vec3f) -> array<f32, 9> {
    return array<f32, 9>(
        1.0, d.x, d.y, d.z, d.x * d.y, d.y * d.z, d.x * d.z, d.x * d.x - d.y * d.y, 3.0 * d.z * d.z - 1.0,
    );
}

fn background(view: View, loss_inputs: LossInputs, pixel: u32) -> vec3f {
    if loss_inputs.modes.x == 1u {
        return loss_inputs.background[0].xyz;
    }
    var basis = sky_basis(direction_through(view, pixel % view.frame.x, pixel / view.frame.x));
    var colour = vec3f(0.0);
    for (var k = 0u; k < 9u; k += 1u) {
        colour += basis[k] * loss_inputs.background[k].xyz;
    }
    return colour;
}
