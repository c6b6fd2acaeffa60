//! Text of USD stages: header, arrays, mesh, material.

use std::io::{self, Write};

use glam::Vec3;

use super::mesh_file::MeshFile;

/// Frame rate of stages with at most one frame.
const DEFAULT_RATE: f64 = 30.0;

/// Frame rate and range of a stage's animation.
pub(super) struct Times {
    /// Time codes per second: the mean frame rate, rounded.
    rate: f64,
    first_secs: f64,
    last_secs: f64,
}

impl Times {
    /// Returns the times of frames, seconds, ascending; `None` without frames.
    pub(super) fn new(mut secs: impl ExactSizeIterator<Item = f64>) -> Option<Self> {
        let spans = secs.len().saturating_sub(1) as f64;
        let first_secs = secs.next()?;
        let last_secs = secs.last().unwrap_or(first_secs);
        let rate = if spans > 0.0 { (spans / (last_secs - first_secs)).round().max(1.0) } else { DEFAULT_RATE };
        Some(Self { rate, first_secs, last_secs })
    }

    /// Returns the time code of a time, in frames.
    pub(super) fn code(&self, secs: f64) -> f64 {
        secs * self.rate
    }
}

/// Writes the header of a stage in metres, y up, whose default prim is `Root`.
pub(super) fn write_header(out: &mut impl Write, times: Option<&Times>) -> io::Result<()> {
    write!(out, "#usda 1.0\n(\n    defaultPrim = \"Root\"\n    metersPerUnit = 1\n    upAxis = \"Y\"\n")?;
    if let Some(times) = times {
        let (first, last) = (times.code(times.first_secs), times.code(times.last_secs));
        write!(out, "    startTimeCode = {first}\n    endTimeCode = {last}\n")?;
        write!(out, "    timeCodesPerSecond = {0}\n    framesPerSecond = {0}\n", times.rate)?;
    }
    writeln!(out, ")\n")
}

/// Writes an array of numbers.
pub(super) fn write_list<T: std::fmt::Display>(
    out: &mut impl Write,
    values: impl Iterator<Item = T>,
) -> io::Result<()> {
    write!(out, "[")?;
    for (i, value) in values.enumerate() {
        write!(out, "{}{value}", if i == 0 { "" } else { ", " })?;
    }
    write!(out, "]")
}

/// Writes an array of tuples of numbers.
pub(super) fn write_tuples<const N: usize>(
    out: &mut impl Write,
    tuples: impl Iterator<Item = [f32; N]>,
) -> io::Result<()> {
    write!(out, "[")?;
    for (i, tuple) in tuples.enumerate() {
        write!(out, "{}", if i == 0 { "(" } else { ", (" })?;
        for (k, value) in tuple.iter().enumerate() {
            write!(out, "{}{value}", if k == 0 { "" } else { ", " })?;
        }
        write!(out, ")")?;
    }
    write!(out, "]")
}

/// Writes an array of vectors.
pub(super) fn write_vectors(out: &mut impl Write, vectors: &[Vec3]) -> io::Result<()> {
    write_tuples(out, vectors.iter().map(Vec3::to_array))
}

/// Writes the lowest and highest corner of points.
pub(super) fn write_extent(out: &mut impl Write, points: &[Vec3]) -> io::Result<()> {
    let low = points.iter().copied().fold(Vec3::INFINITY, Vec3::min);
    let high = points.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
    write_vectors(out, &[low, high])
}

/// Writes the opening of the mesh `Root/Mesh`: triangles, texture coordinates and bound material. Points, normals and the
/// closing brace are left to the caller.
pub(super) fn write_mesh_opening(out: &mut impl Write, mesh: &MeshFile<'_>) -> io::Result<()> {
    let binds_material = mesh.texture.is_some();
    let schemas: Vec<&str> =
        [binds_material.then_some("\"MaterialBindingAPI\""), mesh.skeleton.is_some().then_some("\"SkelBindingAPI\"")]
            .into_iter()
            .flatten()
            .collect();
    write!(out, "    def Mesh \"Mesh\"")?;
    if !schemas.is_empty() {
        write!(out, " (\n        prepend apiSchemas = [{}]\n    )", schemas.join(", "))?;
    }
    write!(out, "\n    {{\n        uniform token subdivisionScheme = \"none\"\n")?;
    write!(out, "        uniform token orientation = \"rightHanded\"\n        int[] faceVertexCounts = ")?;
    write_list(out, mesh.triangles.iter().map(|_| 3))?;
    write!(out, "\n        int[] faceVertexIndices = ")?;
    write_list(out, mesh.triangles.as_flattened().iter())?;
    if !mesh.uvs.is_empty() {
        write!(out, "\n        texCoord2f[] primvars:st = ")?;
        // The origin of USD's texture coordinates is the bottom left corner.
        write_tuples(out, mesh.uvs.iter().map(|uv| [uv.x, 1.0 - uv.y]))?;
        write!(out, " (\n            interpolation = \"vertex\"\n        )")?;
    }
    if binds_material {
        write!(out, "\n        rel material:binding = </Root/Material>")?;
    }
    writeln!(out)
}

/// Writes the material `Root/Material`: a texture file is its diffuse colour or, unlit, what it emits.
pub(super) fn write_material(out: &mut impl Write, texture: &str, is_lit: bool) -> io::Result<()> {
    let color = if is_lit { "diffuseColor" } else { "emissiveColor" };
    let dark = if is_lit { "" } else { "\n            color3f inputs:diffuseColor = (0, 0, 0)" };
    writeln!(
        out,
        r#"
    def Material "Material"
    {{
        token outputs:surface.connect = </Root/Material/Surface.outputs:surface>

        def Shader "Surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:{color}.connect = </Root/Material/Texture.outputs:rgb>{dark}
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }}

        def Shader "Texture"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{texture}@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </Root/Material/Coordinates.outputs:result>
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float3 outputs:rgb
        }}

        def Shader "Coordinates"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}"#
    )
}
