//! Text of USD skeletons (`UsdSkel`).

use std::collections::HashSet;
use std::io::{self, Write};

use glam::Mat4;

use super::mesh_file::{MeshJoint, MeshSkeleton};
use super::usd_text::{Times, write_list, write_tuples, write_vectors};

/// Writes the skin weights of `Root/Mesh`, inside of it.
pub(super) fn write_skin(out: &mut impl Write, skeleton: &MeshSkeleton<'_>) -> io::Result<()> {
    const KIND: &str = " (\n            elementSize = 4\n            interpolation = \"vertex\"\n        )";
    write!(out, "        int[] primvars:skel:jointIndices = ")?;
    write_list(out, skeleton.indices.as_flattened().iter())?;
    write!(out, "{KIND}\n        float[] primvars:skel:jointWeights = ")?;
    write_list(out, skeleton.weights.as_flattened().iter())?;
    write!(out, "{KIND}\n        matrix4d primvars:skel:geomBindTransform = ")?;
    write_matrix(out, &Mat4::IDENTITY)?;
    writeln!(out, "\n        rel skel:skeleton = </Root/Skeleton>")
}

/// Writes the skeleton `Root/Skeleton` and its animation.
pub(super) fn write_skeleton(
    out: &mut impl Write,
    skeleton: &MeshSkeleton<'_>,
    times: Option<&Times>,
) -> io::Result<()> {
    let joints = joint_paths(skeleton);
    write!(out, "\n    def Skeleton \"Skeleton\"")?;
    if times.is_some() {
        write!(out, " (\n        prepend apiSchemas = [\"SkelBindingAPI\"]\n    )")?;
    }
    write!(out, "\n    {{\n        uniform token[] joints = ")?;
    write_list(out, joints.iter().map(|path| format!("\"{path}\"")))?;
    for (name, transform) in [
        ("bindTransforms", (|joint| joint.mesh_from_joint) as fn(&MeshJoint<'_>) -> Mat4),
        ("restTransforms", |joint| joint.parent_from_joint),
    ] {
        write!(out, "\n        uniform matrix4d[] {name} = [")?;
        for (i, joint) in skeleton.joints.iter().enumerate() {
            write!(out, "{}", if i == 0 { "" } else { ", " })?;
            write_matrix(out, &transform(joint))?;
        }
        write!(out, "]")?;
    }
    writeln!(out)?;
    if let Some(times) = times {
        writeln!(out, "        rel skel:animationSource = </Root/Skeleton/Animation>\n")?;
        write_animation(out, skeleton, &joints, times)?;
    }
    writeln!(out, "    }}")
}

fn write_animation(
    out: &mut impl Write,
    skeleton: &MeshSkeleton<'_>,
    joints: &[String],
    times: &Times,
) -> io::Result<()> {
    write!(out, "        def SkelAnimation \"Animation\"\n        {{\n            uniform token[] joints = ")?;
    write_list(out, joints.iter().map(|path| format!("\"{path}\"")))?;
    write!(out, "\n            half3[] scales = ")?;
    write_tuples(out, joints.iter().map(|_| [1.0f32; 3]))?;
    write!(out, "\n            float3[] translations.timeSamples = {{\n")?;
    for frame in skeleton.frames {
        write!(out, "                {}: ", times.code(frame.secs))?;
        write_vectors(out, frame.translations)?;
        writeln!(out, ",")?;
    }
    write!(out, "            }}\n            quatf[] rotations.timeSamples = {{\n")?;
    for frame in skeleton.frames {
        write!(out, "                {}: ", times.code(frame.secs))?;
        write_tuples(out, frame.rotations.iter().map(|q| [q.w, q.x, q.y, q.z]))?;
        writeln!(out, ",")?;
    }
    writeln!(out, "            }}\n        }}")
}

/// Writes a matrix whose rows are the columns of `matrix`: USD multiplies row vectors from the left.
fn write_matrix(out: &mut impl Write, matrix: &Mat4) -> io::Result<()> {
    let [x, y, z, w] = matrix.to_cols_array_2d().map(|row| row.map(|value| value.to_string()).join(", "));
    write!(out, "(({x}), ({y}), ({z}), ({w}))")
}

/// Returns the path of each joint, such as `hips/spine`, of names that USD allows and that are unique.
fn joint_paths(skeleton: &MeshSkeleton<'_>) -> Vec<String> {
    let mut paths: Vec<String> = Vec::with_capacity(skeleton.joints.len());
    let mut taken = HashSet::new();
    for (i, joint) in skeleton.joints.iter().enumerate() {
        let mut name: String = joint.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
            name.insert(0, '_');
        }
        let prefix = joint.parent.map(|parent| format!("{}/", paths[parent])).unwrap_or_default();
        let mut path = format!("{prefix}{name}");
        while !taken.insert(path.clone()) {
            path = format!("{path}_{i}");
        }
        paths.push(path);
    }
    paths
}
