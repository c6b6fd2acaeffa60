//! Files of the page, embedded in the program.

use std::{io::Write as _, sync::LazyLock};

use flate2::{Compression, write::GzEncoder};
use flyrig_renderer::BrowserKernels;
use hyper::body::Bytes;
use serde_json::{Map, Value, json};

/// File of the page.
pub(crate) struct Asset {
    pub path: &'static str,
    pub kind: &'static str,
    pub bytes: Bytes,
    /// The bytes, compressed by gzip.
    pub packed: Bytes,
}

impl Asset {
    fn new(path: &'static str, kind: &'static str, bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        let mut packed = GzEncoder::new(Vec::new(), Compression::best());
        // Writing to memory cannot fail.
        let packed = packed.write_all(&bytes).and_then(|()| packed.finish()).unwrap_or_default();
        Self { path, kind, bytes, packed: packed.into() }
    }
}

const SCRIPT: &str = "text/javascript; charset=utf-8";

/// All files of the page.
static ASSETS: LazyLock<[Asset; 6]> = LazyLock::new(|| {
    let file = |path, kind, bytes: &'static [u8]| Asset::new(path, kind, bytes);
    [
        file("/", "text/html; charset=utf-8", include_bytes!("../assets/index.html")),
        file("/page.js", SCRIPT, include_bytes!("../assets/page.js")),
        file("/draw_webgl2.js", SCRIPT, include_bytes!("../assets/draw_webgl2.js")),
        file("/draw_webgpu.js", SCRIPT, include_bytes!("../assets/draw_webgpu.js")),
        file("/page.wasm", "application/wasm", include_bytes!("../assets/page.wasm")),
        Asset::new("/kernels.json", "application/json", kernels()),
    ]
});

/// Returns the file at a path.
pub(crate) fn asset(path: &str) -> Option<&'static Asset> {
    ASSETS.iter().find(|asset| asset.path == path)
}

/// Returns [`BrowserKernels`] as JSON, with an object for each list.
fn kernels() -> String {
    let BrowserKernels { modules, numbers, frame } = BrowserKernels::new();
    let modules: Map<String, Value> = modules.map(|(name, wgsl)| (name.to_owned(), wgsl.into())).into_iter().collect();
    let numbers: Map<String, Value> =
        numbers.map(|(name, value)| (name.to_owned(), value.into())).into_iter().collect();
    let frame: Map<String, Value> = frame.map(|(name, offset)| (name.to_owned(), offset.into())).into_iter().collect();
    json!({ "modules": modules, "numbers": numbers, "frame": frame }).to_string()
}
