//! Hand-made bodies.
#![allow(dead_code)]

use flyrig_body::{Joint, Part, Skeleton, SkinWeights, Template};
use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

/// A skeleton with one joint at the origin.
pub fn one_joint() -> Skeleton {
    Skeleton::new(vec![Joint {
        name: "root".to_owned(),
        parent: None,
        rest_translation: DVec3::ZERO,
        rest_rotation: DQuat::IDENTITY,
        joint_from_canonical: DMat4::IDENTITY,
    }])
    .unwrap()
}

/// A grid of `columns` x `rows` vertices bent by `place(u, v)` with u, v in 0..=1.
pub fn sheet(columns: usize, rows: usize, place: impl Fn(f32, f32) -> Vec3) -> Template {
    let mut template = empty();
    add_sheet(&mut template, columns, rows, place);
    template
}

pub fn empty() -> Template {
    Template::empty("hand-made", one_joint())
}

pub fn add_sheet(template: &mut Template, columns: usize, rows: usize, place: impl Fn(f32, f32) -> Vec3) {
    let first = template.positions.len() as u32;
    for row in 0..rows {
        for column in 0..columns {
            let (u, v) = (column as f32 / (columns - 1) as f32, row as f32 / (rows - 1) as f32);
            let step = 1e-3;
            let normal = (place(u + step, v) - place(u, v)).cross(place(u, v + step) - place(u, v));
            template.positions.push(place(u, v));
            template.normals.push(normal.normalize());
            template.uvs.push(Vec2::new(u, v));
            template.skin.push(SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] });
            template.parts.push(Part::Torso);
        }
    }
    let at = |column: usize, row: usize| first + (row * columns + column) as u32;
    for row in 0..rows - 1 {
        for column in 0..columns - 1 {
            let [a, b, c, d] = [at(column, row), at(column + 1, row), at(column + 1, row + 1), at(column, row + 1)];
            template.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
}

/// A flat square of one metre.
pub fn square() -> Template {
    sheet(11, 11, |u, v| Vec3::new(u, v, 0.0))
}
