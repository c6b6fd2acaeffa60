//! Every kernel is parsed and validated without a GPU.

use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

use super::*;
use crate::backward::kernels as backward;
use crate::sort::radix::sort_wgsl;
use crate::sort::scan::scan_wgsl;

fn validate(name: &str, source: &str) {
    assert!(!source.contains("var<uniform>"), "{name}: see constants.rs");
    let module =
        naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
    Validator::new(ValidationFlags::all(), Capabilities::empty())
        .validate(&module)
        .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
}

#[test]
fn every_kernel_is_valid_wgsl_and_the_uniform_has_its_layout() {
    validate("scan", &scan_wgsl());
    validate("sort", &sort_wgsl());
    validate("view bytes", &[flyrig_model::srgb::WGSL, crate::view_bytes::WGSL].concat());
    for tile in [Tile::SOFTWARE, Tile::HARDWARE] {
        validate("project", &project_wgsl(tile));
        validate("project anisotropic", &project_anisotropic_wgsl(tile));
        for bits in 0..8 {
            let outputs = Outputs { color: bits & 1 != 0, depth: bits & 2 != 0, canonical: bits & 4 != 0 };
            validate("blend", &blend_wgsl(tile, outputs));
        }
        for switch in [false, true] {
            validate("blend backward", &backward::blend_wgsl(tile, switch, false));
            validate("blend backward, colours carried", &backward::blend_wgsl(tile, switch, true));
            validate("project backward", &backward::project_wgsl(switch));
        }
    }
    for order in HarmonicOrder::ALL {
        validate("paint", &paint_wgsl(order));
        validate("paint backward", &backward::paint_wgsl(order));
        validate("recolor", &crate::anisotropic::recolor::recolor_wgsl(order));
    }
    validate("join", crate::anisotropic::join::WGSL);
    validate("bins", &bins_wgsl());
    validate("places", &backward::places_wgsl());
    validate("sums", &backward::sums_wgsl());
    validate("project anisotropic backward", &backward::project_anisotropic_wgsl());
    let module = naga::front::wgsl::parse_str(&bins_wgsl()).unwrap();
    let frame = module.types.iter().find(|(_, t)| t.name.as_deref() == Some("Frame")).unwrap().1;
    let naga::TypeInner::Struct { span, .. } = frame.inner else { panic!("FrameConstants is a struct") };
    assert_eq!(span as usize, size_of::<FrameConstants>());
}

/// Storage buffers that a browser's adapter offers a shader stage at least (WebGPU's default limit).
const BROWSER_STORAGE_BUFFERS: usize = 8;

/// Number of storage buffers in the derived layout of each entry point.
fn storage_buffers(source: &str) -> Vec<(String, usize)> {
    let module = naga::front::wgsl::parse_str(source).unwrap();
    let info: ModuleInfo = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module).unwrap();
    let count = |(index, entry): (usize, &naga::EntryPoint)| {
        let uses = info.get_entry_point(index);
        let bound = module.global_variables.iter().filter(|(handle, variable)| {
            matches!(variable.space, naga::AddressSpace::Storage { .. }) && !uses[*handle].is_empty()
        });
        (entry.name.clone(), bound.count())
    };
    module.entry_points.iter().enumerate().map(count).collect()
}

#[test]
fn drawing_needs_no_more_storage_buffers_than_browsers_promise() {
    let tile = Tile::HARDWARE;
    let mut sources = vec![project_wgsl(tile), bins_wgsl(), scan_wgsl(), sort_wgsl()];
    sources.extend([project_anisotropic_wgsl(tile), backward::sums_wgsl(), backward::project_anisotropic_wgsl()]);
    sources.extend(HarmonicOrder::ALL.into_iter().flat_map(|order| [paint_wgsl(order), backward::paint_wgsl(order)]));
    for bits in 0..8 {
        let outputs = Outputs { color: bits & 1 != 0, depth: bits & 2 != 0, canonical: bits & 4 != 0 };
        let (passes, count) = blend_passes(outputs);
        let written = passes[..count]
            .iter()
            .fold([false; 3], |[c, d, k], pass| [c | pass.color, d | pass.depth, k | pass.canonical]);
        assert_eq!(written, [outputs.color, outputs.depth, outputs.canonical]);
        sources.extend(passes[..count].iter().map(|&pass| blend_wgsl(tile, pass)));
    }
    let counts: Vec<_> = sources.iter().flat_map(|source| storage_buffers(source)).collect();
    println!("{counts:?}");
    assert_eq!(counts.iter().filter(|(name, _)| name == "blend").count(), 9);
    for (name, count) in counts {
        assert!(count <= BROWSER_STORAGE_BUFFERS, "{name} binds {count} storage buffers");
    }
}
