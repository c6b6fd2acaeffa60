//! Every kernel is parsed and validated without a GPU.

use naga::valid::{Capabilities, ValidationFlags, Validator};

use super::*;
use crate::raster_backward;
use crate::scan::{SCAN_WGSL, scan_prefix};
use crate::sort::SORT_WGSL;

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
    for shape in [RasterShape::SOFTWARE, RasterShape::HARDWARE] {
        validate("scan", &[&scan_prefix(shape.sort.chunks), SCAN_WGSL].concat());
        validate("sort", &[&shape.sort.wgsl(), SORT_WGSL].concat());
        validate("project", &project_wgsl(shape));
        for bits in 0..8 {
            let outputs = Outputs { color: bits & 1 != 0, depth: bits & 2 != 0, canonical: bits & 4 != 0 };
            validate("blend", &blend_wgsl(shape, outputs));
        }
        for switch in [false, true] {
            validate("blend backward", &raster_backward::blend_wgsl(shape, switch));
            validate("project backward", &raster_backward::project_wgsl(switch));
        }
    }
    validate("bins", &bins_wgsl());
    validate("places", &raster_backward::places_wgsl());
    let module = naga::front::wgsl::parse_str(&bins_wgsl()).unwrap();
    let frame = module.types.iter().find(|(_, t)| t.name.as_deref() == Some("Frame")).unwrap().1;
    let naga::TypeInner::Struct { span, .. } = frame.inner else { panic!("Frame is a struct") };
    assert_eq!(span as usize, size_of::<Frame>());
}
