//! Every kernel is valid, for every number of channels it is built for. Needs no GPU.

use naga::valid::{Capabilities, ValidationFlags, Validator};
use segwild_gpu::{KERNELS, source};

/// Limits that WebGPU guarantees on every device.
const STORAGE_BUFFERS: usize = 8;
const SHARED_BYTES: u32 = 16 << 10;

/// The kernel as naga reads it for a device with or without subgroups, or what is wrong in it.
fn valid(text: &str, subgroups: bool) -> Result<naga::Module, String> {
    let module = naga::front::wgsl::parse_str(text).map_err(|error| error.emit_to_string(text))?;
    let available = if subgroups { Capabilities::SUBGROUP } else { Capabilities::empty() };
    Validator::new(ValidationFlags::all(), available)
        .validate(&module)
        .map_err(|error| error.emit_to_string(text))?;
    Ok(module)
}

#[test]
fn every_kernel_is_valid_and_within_what_every_device_offers() {
    for kernel in KERNELS {
        let built = kernel.blocks.iter().flat_map(|&blocks| [(blocks, false), (blocks, true)]);
        for (blocks, subgroups) in built {
            let text = source(kernel, blocks, subgroups);
            let by = if subgroups { ", by subgroups" } else { "" };
            let name = format!("{} for {blocks} blocks{by}", kernel.name);
            let module = valid(&text, subgroups).unwrap_or_else(|error| panic!("{name}: {error}"));
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

/// Why a line that starts a loop may not end; `None` where it counts towards a bound, or is known to end.
fn endless(line: &str) -> Option<String> {
    // A search that halves what is left, and the row of a triangle in which a number lies.
    let known = ["while low < high {", "while (a + 1u) * (a + 2u) / 2u <= local {"];
    let line = line.trim();
    let Some(head) = line.strip_prefix("for (") else {
        let starts = ["loop", "while", "for"]
            .iter()
            .any(|word| line.strip_prefix(word).is_some_and(|rest| rest.starts_with([' ', '(', '{'])));
        return (starts && !known.contains(&line)).then(|| line.to_owned());
    };
    let parts: Vec<&str> = head.split(';').map(str::trim).collect();
    let counts = parts.len() == 3 && {
        let step: Vec<&str> = parts[2].split(' ').collect();
        let compared = |by: &str| parts[1].contains(&format!("{} {by} ", step[0]));
        match step.get(1) {
            Some(&("+=" | "*=")) => compared("<") || compared("<="),
            Some(&"/=") => compared(">"),
            _ => false,
        }
    };
    (!counts).then(|| line.to_owned())
}

/// They run without the counters by which wgpu would end those that do not.
#[test]
fn every_loop_of_a_kernel_ends() {
    let mut loops = 0;
    for kernel in KERNELS {
        for line in source(kernel, 1, true).lines() {
            assert_eq!(endless(line), None, "{}", kernel.name);
            loops += usize::from(line.trim_start().starts_with("for ("));
        }
    }
    assert!(loops > 100, "{loops} loops");
    for line in ["loop {", "while true {", "for (;;) {", "for (var k = 0u; k < n; j += 1u) {"] {
        assert!(endless(line).is_some(), "{line}");
    }
}

#[test]
fn a_kernel_that_is_not_valid_is_seen() {
    let kernel = KERNELS.iter().find(|kernel| kernel.name == "histogram").expect("there is one");
    let text = source(kernel, 1, false);
    let mistyped = text.replace("let digit", "let digit: f32").replace("block * 1024u", "block * 1024.0");
    assert!(valid(&mistyped, false).is_err(), "a whole number times a fraction");
    assert!(valid(&text, false).is_ok());
    let unbound =
        text.replace("@binding(2) var<storage, read_write>", "@binding(1) var<storage, read_write>");
    assert!(unbound != text && valid(&unbound, false).is_err(), "two arrays at one binding");
}

#[test]
fn running_sums_and_the_sort_go_by_subgroups_where_there_are_some() {
    let others = KERNELS.iter().filter(|kernel| source(kernel, 1, true) != source(kernel, 1, false));
    let others: Vec<_> = others.collect();
    assert_eq!(others.iter().map(|kernel| kernel.name).collect::<Vec<_>>(), ["scan", "scatter"]);
    for kernel in others {
        let error =
            valid(&source(kernel, 1, true), false).expect_err("a device without subgroups refuses it");
        assert!(error.to_lowercase().contains("subgroup") || error.contains("apabilit"), "{error}");
    }
}
