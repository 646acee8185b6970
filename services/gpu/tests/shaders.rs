//! Every kernel is valid, for every number of channels it is built for. Needs no GPU.

use naga::valid::{Capabilities, ValidationFlags, Validator};
use segwild_gpu::{KERNELS, source};

/// What WebGPU promises of every device.
const STORAGE_BUFFERS: usize = 8;
const SHARED_BYTES: u32 = 16 << 10;

/// The kernel as naga reads it, or what is wrong in it.
fn valid(text: &str) -> Result<naga::Module, String> {
    let module = naga::front::wgsl::parse_str(text).map_err(|error| error.emit_to_string(text))?;
    Validator::new(ValidationFlags::all(), Capabilities::empty())
        .validate(&module)
        .map_err(|error| error.emit_to_string(text))?;
    Ok(module)
}

#[test]
fn every_kernel_is_valid_and_within_what_every_device_offers() {
    for kernel in KERNELS {
        for &blocks in kernel.blocks {
            let text = source(kernel, blocks);
            let name = format!("{} for {blocks} blocks", kernel.name);
            let module = valid(&text).unwrap_or_else(|error| panic!("{name}: {error}"));
            let entry = &module.entry_points[0];
            assert_eq!((module.entry_points.len(), entry.name.as_str()), (1, kernel.entry), "{name}");
            let threads: u32 = entry.workgroup_size.iter().product();
            assert!(threads <= 256, "{name}: {threads} threads");
            let (mut storage, mut shared) = (0, 0);
            for (_, variable) in module.global_variables.iter() {
                match variable.space {
                    naga::AddressSpace::Storage { .. } => storage += 1,
                    naga::AddressSpace::WorkGroup => {
                        shared += module.types[variable.ty].inner.size(module.to_ctx());
                    }
                    _ => {}
                }
            }
            assert!(storage <= STORAGE_BUFFERS, "{name}: {storage} storage buffers");
            assert!(shared <= SHARED_BYTES, "{name}: {shared} bytes shared by a group");
        }
    }
}

#[test]
fn a_kernel_that_is_not_valid_is_seen() {
    let kernel = KERNELS.iter().find(|kernel| kernel.name == "histogram").expect("there is one");
    let text = source(kernel, 1);
    let mistyped = text.replace("let digit", "let digit: f32").replace("block * 1024u", "block * 1024.0");
    assert!(valid(&mistyped).is_err(), "a whole number times a fraction");
    assert!(valid(&text).is_ok());
    let unbound =
        text.replace("@binding(2) var<storage, read_write>", "@binding(1) var<storage, read_write>");
    assert!(unbound != text && valid(&unbound).is_err(), "two arrays at one place");
}
