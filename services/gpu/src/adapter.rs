//! Lists the accelerators, and opens one.

use crate::GpuError;
use wgpu::{Backends, DeviceType, Features, Instance, InstanceDescriptor, Limits};

/// An accelerator, as its driver describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// Its name.
    pub name: String,
    /// `Vulkan`, `Metal` or `Dx12`.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `unknown`.
    pub kind: &'static str,
    /// The driver's name and version.
    pub driver: String,
    /// Bytes that one array may have.
    pub binding: u64,
    /// Bytes that threads of a group share.
    pub shared: u64,
    /// Fewest and most threads of a subgroup; `None` where kernels do without, because it has none or by choice.
    pub subgroups: Option<(u32, u32)>,
}

impl Adapter {
    /// Whether it is a program on the CPU: much slower than the CPU engine, so it is only taken by its name.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }
}

/// Which accelerator to take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AdapterChoice {
    /// The best that is not software.
    Hardware,
    /// The first whose name contains this, in any case; software too.
    Named(String),
}

/// Why there is no accelerator where [`adapters`] has none. Drivers are libraries that are loaded at run time, and a
/// program that is linked statically to musl loads none.
pub const NO_DRIVER: &str = if cfg!(all(target_env = "musl", target_feature = "crt-static")) {
    "this program is linked statically and loads no driver; the program for linux-gnu does"
} else {
    "no Vulkan, Metal or Direct3D 12 driver answers"
};

/// All accelerators, best first.
pub fn adapters() -> Vec<Adapter> {
    list().iter().map(describe).collect()
}

fn list() -> Vec<wgpu::Adapter> {
    let instance = Instance::new(InstanceDescriptor::new_without_display_handle());
    let mut found = pollster::block_on(instance.enumerate_adapters(Backends::PRIMARY));
    found.sort_by_key(|adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    });
    found
}

fn describe(adapter: &wgpu::Adapter) -> Adapter {
    let (info, limits) = (adapter.get_info(), adapter.limits());
    Adapter {
        kind: match info.device_type {
            DeviceType::DiscreteGpu => "discrete",
            DeviceType::IntegratedGpu => "integrated",
            DeviceType::VirtualGpu => "virtual",
            DeviceType::Other => "unknown",
            DeviceType::Cpu => "software",
        },
        backend: format!("{:?}", info.backend),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        name: info.name,
        binding: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
        shared: u64::from(limits.max_compute_workgroup_storage_size),
        subgroups: adapter
            .features()
            .contains(Features::SUBGROUP)
            .then_some((info.subgroup_min_size, info.subgroup_max_size)),
    }
}

/// Opens the accelerator of this choice, with `subgroups` if it has some.
pub(crate) fn open(
    choice: &AdapterChoice,
    subgroups: bool,
) -> Result<(Adapter, wgpu::Device, wgpu::Queue), GpuError> {
    let all = list();
    let mut described: Vec<Adapter> = all.iter().map(describe).collect();
    let at = match choice {
        AdapterChoice::Hardware => described.iter().position(|adapter| !adapter.is_software()),
        AdapterChoice::Named(part) => {
            let part = part.to_lowercase();
            described.iter().position(|adapter| adapter.name.to_lowercase().contains(&part))
        }
    };
    let Some(at) = at else { return Err(GpuError::NoAdapter(none_of(choice, &described))) };
    let limits = wanted(&described[at], &all[at].limits())?;
    let mut adapter = described.swap_remove(at);
    adapter.subgroups = adapter.subgroups.filter(|_| subgroups);
    let mut features = Features::TIMESTAMP_QUERY;
    features.set(Features::SUBGROUP, adapter.subgroups.is_some());
    let (device, queue) = pollster::block_on(all[at].request_device(&wgpu::DeviceDescriptor {
        label: Some("segwild"),
        required_limits: limits,
        required_features: all[at].features() & features,
        ..Default::default()
    }))
    .map_err(|error| GpuError::Failed { adapter: adapter.name.clone(), why: error.to_string() })?;
    Ok((adapter, device, queue))
}

fn none_of(choice: &AdapterChoice, all: &[Adapter]) -> String {
    let names = all.iter().map(|a| format!("{} ({})", a.name, a.kind)).collect::<Vec<_>>().join(", ");
    match (choice, all.is_empty()) {
        (_, true) => format!("no accelerator was found: {NO_DRIVER}"),
        (AdapterChoice::Hardware, false) => format!(
            "the only accelerators here are programs on the CPU, slower than the CPU engine: {names}; `--adapter` takes one \
             by its name all the same"
        ),
        (AdapterChoice::Named(part), false) => {
            format!("no accelerator's name contains `{part}`; there are: {names}")
        }
    }
}

/// Requests the minimum limits of WebGPU, which the kernels need, and the largest array size that the adapter offers.
fn wanted(adapter: &Adapter, available: &Limits) -> Result<Limits, GpuError> {
    let least = Limits::default();
    let checks = [
        (
            "storage buffers per kernel",
            u64::from(available.max_storage_buffers_per_shader_stage),
            u64::from(least.max_storage_buffers_per_shader_stage),
        ),
        (
            "threads per group",
            u64::from(available.max_compute_invocations_per_workgroup),
            u64::from(least.max_compute_invocations_per_workgroup),
        ),
        (
            "memory per group",
            u64::from(available.max_compute_workgroup_storage_size),
            u64::from(least.max_compute_workgroup_storage_size),
        ),
        (
            "groups per dimension",
            u64::from(available.max_compute_workgroups_per_dimension),
            u64::from(least.max_compute_workgroups_per_dimension),
        ),
    ];
    for (what, available, needed) in checks {
        if available < needed {
            return Err(GpuError::TooSmall { adapter: adapter.name.clone(), what, available, needed });
        }
    }
    Ok(Limits {
        max_storage_buffer_binding_size: available.max_storage_buffer_binding_size,
        max_buffer_size: available.max_buffer_size,
        ..least.or_worse_values_from(available)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn llvmpipe() -> Adapter {
        Adapter {
            name: "llvmpipe (LLVM 15)".into(),
            backend: "Vulkan".into(),
            kind: "software",
            driver: "Mesa".into(),
            binding: 1 << 27,
            shared: 1 << 15,
            subgroups: Some((8, 8)),
        }
    }

    #[test]
    fn a_missing_adapter_is_reported_with_those_available() {
        assert!(none_of(&AdapterChoice::Hardware, &[]).contains(NO_DRIVER));
        let text = none_of(&AdapterChoice::Hardware, &[llvmpipe()]);
        assert!(
            text.contains("slower than the CPU engine") && text.contains("llvmpipe (LLVM 15) (software)"),
            "{text}"
        );
        let text = none_of(&AdapterChoice::Named("radeon".into()), &[llvmpipe()]);
        assert!(text.contains("`radeon`") && text.contains("llvmpipe"), "{text}");
    }

    #[test]
    fn arrays_may_be_as_long_as_the_adapter_binds_and_not_only_what_webgpu_promises() {
        // The moments of 40 million pairs: a view of five million splats.
        let moments = 40_000_000 * size_of::<[f32; 8]>() as u64;
        let least = Limits::default();
        assert!(moments > least.max_storage_buffer_binding_size && moments > least.max_buffer_size);
        let large = u64::from(u32::MAX) - 3;
        let available = Limits { max_storage_buffer_binding_size: large, max_buffer_size: large, ..least };
        let limits = wanted(&llvmpipe(), &available).expect("it offers more than is needed");
        assert_eq!((limits.max_storage_buffer_binding_size, limits.max_buffer_size), (large, large));
        assert!(moments <= limits.max_storage_buffer_binding_size);
    }

    #[test]
    fn a_limit_that_is_too_small_is_named_with_its_number() {
        let available = Limits { max_storage_buffers_per_shader_stage: 4, ..Limits::default() };
        let error = wanted(&llvmpipe(), &available).expect_err("four buffers are too few");
        assert_eq!(
            error.to_string(),
            "llvmpipe (LLVM 15): storage buffers per kernel is 4 where the kernels need 8"
        );
    }
}
