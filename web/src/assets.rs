//! Files of the page, in the program itself.

/// A file of the page.
pub(crate) struct Asset {
    pub path: &'static str,
    pub kind: &'static str,
    pub bytes: &'static [u8],
}

/// All files.
const ASSETS: [Asset; 4] = [
    Asset { path: "/", kind: "text/html; charset=utf-8", bytes: include_bytes!("../assets/index.html") },
    Asset { path: "/page.js", kind: "text/javascript; charset=utf-8", bytes: include_bytes!("../assets/page.js") },
    Asset { path: "/draw.js", kind: "text/javascript; charset=utf-8", bytes: include_bytes!("../assets/draw.js") },
    Asset { path: "/page.wasm", kind: "application/wasm", bytes: include_bytes!("../assets/page.wasm") },
];

/// Returns the file of a path.
pub(crate) fn asset(path: &str) -> Option<&'static Asset> {
    ASSETS.iter().find(|asset| asset.path == path)
}
