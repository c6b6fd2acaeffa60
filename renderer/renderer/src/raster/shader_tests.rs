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

const DEPTHS: [backward::Depths; 3] = [backward::Depths::None, backward::Depths::Centers, backward::Depths::Planes];

fn outputs_of(bits: u32) -> Outputs {
    let [color, depth, canonical, planes] = [1, 2, 4, 8].map(|bit| bits & bit != 0);
    Outputs { color, depth, canonical, planes }
}

#[test]
fn every_kernel_is_valid_wgsl_and_the_uniform_has_its_layout() {
    validate("scan", &scan_wgsl());
    validate("sort", &sort_wgsl());
    validate("view bytes", &[flyrig_model::srgb::WGSL, crate::view_bytes::WGSL].concat());
    for tile in [Tile::SOFTWARE, Tile::HARDWARE] {
        validate("project", &project_wgsl(tile));
        validate("project anisotropic", &project_anisotropic_wgsl(tile));
        for outputs in (0..16).map(outputs_of) {
            validate("blend", &blend_wgsl(tile, outputs));
        }
        for depths in DEPTHS {
            validate("blend backward", &backward::blend_wgsl(tile, depths, false));
            validate("blend backward, colours carried", &backward::blend_wgsl(tile, depths, true));
        }
    }
    for order in HarmonicOrder::ALL {
        validate("paint", &paint_wgsl(order));
        validate("recolor", &crate::anisotropic::recolor::recolor_wgsl(order));
    }
    validate("join", crate::anisotropic::join::WGSL);
    validate("bins", &bins_wgsl());
    validate("places", &backward::places_wgsl());
    validate("planes", &planes_wgsl());
    for switch in [false, true] {
        validate("project backward", &backward::project_wgsl(switch));
        validate("sums", &backward::sums_wgsl(switch));
        validate("project anisotropic backward", &backward::project_anisotropic_wgsl(switch));
        for order in HarmonicOrder::ALL {
            validate("paint backward", &backward::paint_wgsl(order, switch));
        }
    }
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
    let mut sources = vec![project_wgsl(tile), bins_wgsl(), scan_wgsl(), sort_wgsl(), planes_wgsl()];
    sources.push(project_anisotropic_wgsl(tile));
    for planes in [false, true] {
        sources.extend([backward::sums_wgsl(planes), backward::project_anisotropic_wgsl(planes)]);
        let paint = |order| [paint_wgsl(order), backward::paint_wgsl(order, planes)];
        sources.extend(HarmonicOrder::ALL.into_iter().flat_map(paint));
    }
    for outputs in (0..16).map(outputs_of) {
        let (passes, count) = blend_passes(outputs);
        let images = |o: &Outputs| [o.color, o.depth, o.canonical, o.planes];
        let written = [0, 1, 2, 3].map(|image| passes[..count].iter().any(|pass| images(pass)[image]));
        assert_eq!(written, images(&outputs));
        sources.extend(passes[..count].iter().map(|&pass| blend_wgsl(tile, pass)));
    }
    let counts: Vec<_> = sources.iter().flat_map(|source| storage_buffers(source)).collect();
    println!("{counts:?}");
    assert_eq!(counts.iter().filter(|(name, _)| name == "blend").count(), 23);
    for (name, count) in counts {
        assert!(count <= BROWSER_STORAGE_BUFFERS, "{name} binds {count} storage buffers");
    }
    // `GpuContext` requires 13.
    for depths in DEPTHS {
        let counts = storage_buffers(&backward::blend_wgsl(tile, depths, true));
        assert!(counts.iter().all(|(_, count)| *count <= 13), "{counts:?}");
    }
}
