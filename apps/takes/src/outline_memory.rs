//! Shape of clothes and hair that the outlines of other frames have shown.
//!
//! A mask measures how far a surface stands off the body where the surface's outline runs. Elsewhere the tracked surface is interpolated
//! between outlines, and a node that no outline passes lacks about the same distance in every such frame. That distance is the mean
//! difference between its translations at outlines and away from them, along the surface's normal. It counts less for nodes with few
//! outlines, is averaged over neighbouring nodes, and is added as far as no outline runs.

use flyrig_avatar::{Avatar, Bones, PosedAvatar, TrainingFrame};
use flyrig_fit::TrainingView;
use flyrig_renderer::UNKNOWN_RGBA;
use glam::{Vec3, Vec4};

/// Standard deviation of the cosine between a surface's normal and the line of sight where its outline runs.
const GRAZING: f32 = 0.25;
/// Largest distance of an outline from a Gaussian on either side, metres.
const BESIDE_M: f32 = 0.03;
/// Frames at an outline for which a node's difference counts by half.
const FRAMES: f64 = 2.0;
/// Rounds of averaging over neighbouring nodes.
const ROUNDS: usize = 2;

/// Nodes of a deformation graph on a surface.
#[derive(Debug, Clone)]
pub struct NodeSurface {
    /// Gaussian at each node.
    pub gaussians: Vec<u32>,
    /// Neighbours of each node.
    pub neighbors: Vec<[u32; 4]>,
    /// Canonical unit normals of the surface.
    pub normals: Vec<Vec3>,
}

/// Moves the nodes of each frame by what they lack where no outline runs, and returns the mean movement, metres. `views` are the
/// images of the frames with their masks.
pub fn remember_outlines(
    frames: &mut [TrainingFrame],
    views: &[TrainingView],
    avatar: &Avatar,
    nodes: &NodeSurface,
) -> f64 {
    let mut posed = PosedAvatar::default();
    let mut of_frame = |(at, frame): (usize, &TrainingFrame)| {
        avatar.pose(&Bones::new(&avatar.template.skeleton, &frame.pose), Some(&frame.translations), &mut posed);
        let views: Vec<&TrainingView> = views.iter().filter(|view| view.frame() == at).collect();
        outlined(&posed, &views, nodes)
    };
    let outlined: Vec<Vec<f64>> = frames.iter().enumerate().map(&mut of_frame).collect();
    let mut lacking = lacking(frames, &outlined, nodes);
    for _ in 0..ROUNDS {
        let around = |node: usize| nodes.neighbors[node].iter().map(|&other| lacking[other as usize]).sum::<f64>();
        lacking = (0..lacking.len()).map(|node| (lacking[node] + around(node)) / 5.0).collect();
    }
    let (mut moved, mut count) = (0.0, 0u32);
    for (frame, outlined) in frames.iter_mut().zip(&outlined) {
        for (((translation, outlined), lacking), normal) in
            frame.translations.iter_mut().zip(outlined).zip(&lacking).zip(&nodes.normals)
        {
            let by = (1.0 - outlined) * lacking;
            *translation += normal.as_dvec3() * by;
            moved += by.abs();
            count += 1;
        }
    }
    moved / f64::from(count.max(1))
}

/// Returns how far each node stands out less where no outline runs than where one does, metres, towards 0 for nodes with few outlines; 0
/// where one of the two is unknown.
fn lacking(frames: &[TrainingFrame], outlined: &[Vec<f64>], nodes: &NodeSurface) -> Vec<f64> {
    let of = |(node, normal): (usize, &Vec3)| {
        let (mut at, mut away) = ([0.0; 2], [0.0; 2]);
        for (frame, outlined) in frames.iter().zip(outlined) {
            let Some(translation) = frame.translations.get(node).filter(|by| by.is_finite()) else { continue };
            let (out, outlined) = (translation.dot(normal.as_dvec3()), outlined[node]);
            at = [at[0] + outlined * out, at[1] + outlined];
            away = [away[0] + (1.0 - outlined) * out, away[1] + 1.0 - outlined];
        }
        if at[1] <= 0.0 || away[1] <= 0.0 {
            return 0.0;
        }
        (at[0] / at[1] - away[0] / away[1]) * at[1] / (at[1] + FRAMES)
    };
    nodes.normals.iter().enumerate().map(of).collect()
}

/// Returns how certainly an outline runs at each node in a frame, 0..=1.
fn outlined(posed: &PosedAvatar, views: &[&TrainingView], nodes: &NodeSurface) -> Vec<f64> {
    let normals: Vec<Vec3> = posed.normals().collect();
    let of_node = |&gaussian: &u32| {
        let center = Vec4::from(posed.center[gaussian as usize]).truncate();
        let normal = normals[gaussian as usize];
        let of_view = |view: &&TrainingView| {
            let sight = (center - view.camera().position().as_vec3()).normalize_or_zero();
            let cosine = normal.dot(sight);
            let aside = (normal - sight * cosine).normalize_or_zero() * BESIDE_M;
            let ends = covered(view, center - aside) == Some(true) && covered(view, center + aside) == Some(false);
            if ends { f64::from((-0.5 * (cosine / GRAZING).powi(2)).exp()) } else { 0.0 }
        };
        views.iter().map(of_view).fold(0.0, f64::max)
    };
    nodes.gaussians.iter().map(of_node).collect()
}

/// Returns whether the mask covers a world point, or the pixel of the crop that is nearest to it: around the person, a crop has a margin
/// without a mask. `None` behind the camera, and where another person may hide it.
fn covered(view: &TrainingView, point: Vec3) -> Option<bool> {
    let pixel = view.camera().project(point.as_dvec3()).filter(|pixel| pixel.is_finite())?.round();
    let [width, height] = view.size().map(f64::from);
    let (column, row) = (pixel.x.clamp(0.0, width - 1.0), pixel.y.clamp(0.0, height - 1.0));
    let first = 4 * (row * width + column) as usize;
    let pixel = view.rgba().get(first..first + 4)?;
    (pixel != UNKNOWN_RGBA).then_some(pixel[3] > 127)
}

#[cfg(test)]
mod tests {
    use flyrig_avatar::AvatarScene;
    use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
    use flyrig_gpu::testing::device;
    use flyrig_renderer::HarmonicOrder;
    use flyrig_types::{Camera, Intrinsics, Isometry};
    use glam::{DQuat, DVec3};

    use super::*;

    const SIZE: u32 = 160;
    /// Distance by which clothes stand off everywhere, metres.
    const OFF_M: f64 = 0.02;

    /// Camera that looks at a body which stands at the origin with y up.
    fn camera(angle: f64) -> Camera {
        let center = DVec3::Y * 0.9;
        let eye = center + DQuat::from_rotation_y(-angle) * (DVec3::Z * 2.6);
        Camera::new("view", Intrinsics::pinhole(SIZE, SIZE, 190.0), Isometry::look_at(eye, center, DVec3::Y))
    }

    struct Turn {
        avatar: Avatar,
        nodes: NodeSurface,
        truth: Vec<DVec3>,
        frames: Vec<TrainingFrame>,
        views: Vec<TrainingView>,
    }

    /// Person who turns before three cameras, in clothes that stand off everywhere.
    fn turn() -> Turn {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 4000, 1).unwrap();
        let graph = build_graph(&template, &surface, 200, DEFAULT_SIGMA2_M2).unwrap();
        let avatar = Avatar::new(&template, &surface, Some(&graph), &[[0.5; 3]; 4000], HarmonicOrder::Zero).unwrap();
        let normals: Vec<Vec3> = graph.node_gaussian.iter().map(|&at| surface.normals[at as usize]).collect();
        let truth: Vec<DVec3> = normals.iter().map(|normal| normal.as_dvec3() * OFF_M).collect();
        let nodes = NodeSurface { gaussians: graph.node_gaussian, neighbors: graph.neighbors, normals };
        let mut scene = AvatarScene::new(&device().on_processor(), &avatar).unwrap();
        let (mut frames, mut views) = (Vec::new(), Vec::new());
        for at in 0..12 {
            let mut pose = template.skeleton.rest_pose();
            pose.joint_rotations[0] = DQuat::from_rotation_y(f64::from(at) * 0.5) * pose.joint_rotations[0];
            scene.pose(&avatar, &Bones::new(&template.skeleton, &pose), Some(&truth));
            for angle in [0.0, 2.1, 4.2] {
                let camera = camera(angle);
                let view = scene.draw(&camera).unwrap();
                views.push(TrainingView::cut(frames.len(), &camera, &view.rgba).unwrap());
            }
            frames.push(TrainingFrame { pose, translations: truth.clone() });
        }
        Turn { avatar, nodes, truth, frames, views }
    }

    /// Returns how certainly outlines run at the nodes in a frame of the truth.
    fn outlined_at(turn: &Turn, at: usize, views: &[TrainingView]) -> Vec<f64> {
        let mut posed = PosedAvatar::default();
        let bones = Bones::new(&turn.avatar.template.skeleton, &turn.frames[at].pose);
        turn.avatar.pose(&bones, Some(&turn.truth), &mut posed);
        let views: Vec<&TrainingView> = views.iter().filter(|view| view.frame() == at).collect();
        outlined(&posed, &views, &turn.nodes)
    }

    fn certain(known: &[f64]) -> usize {
        known.iter().filter(|known| **known > 0.5).count()
    }

    fn mean_error_m(frames: &[TrainingFrame], truth: &[DVec3]) -> f64 {
        let errors = frames.iter().flat_map(|frame| frame.translations.iter().zip(truth).map(|(a, b)| a.distance(*b)));
        errors.sum::<f64>() / (frames.len() * truth.len()) as f64
    }

    #[test]
    fn what_outlines_show_is_known_in_all_frames() {
        let turn = turn();
        let Turn { avatar, nodes, truth, views, .. } = &turn;
        // Tracked where an outline runs, and on the bare body elsewhere.
        let mut frames = turn.frames.clone();
        for (at, frame) in frames.iter_mut().enumerate() {
            let known = outlined_at(&turn, at, views);
            assert!((20..150).contains(&certain(&known)), "{known:?}");
            frame.translations.iter_mut().zip(known).for_each(|(by, known)| *by *= known);
        }
        let before = mean_error_m(&frames, truth);
        let moved = remember_outlines(&mut frames, views, avatar, nodes);
        let after = mean_error_m(&frames, truth);
        assert!(before > 0.6 * OFF_M && after < 0.75 * before && moved > 0.15 * OFF_M, "{before} {after} {moved}");
        // What is the same in all frames stays.
        let mut same = turn.frames.clone();
        assert!(remember_outlines(&mut same, views, avatar, nodes) < 1e-9);
        assert!(mean_error_m(&same, truth) < 1e-9);
    }

    #[test]
    fn another_person_in_front_is_no_outline() {
        let turn = turn();
        let seen = certain(&outlined_at(&turn, 0, &turn.views));
        // Somebody hides all that is not this person.
        let hidden = turn.views.iter().map(|view| {
            let hide = |pixel: &[u8]| if pixel[3] > 127 { [0, 0, 0, 255] } else { UNKNOWN_RGBA };
            let rgba: Vec<u8> = view.rgba().chunks_exact(4).flat_map(hide).collect();
            TrainingView::cut(view.frame(), view.camera(), &rgba).unwrap()
        });
        assert!(seen > 20 && certain(&outlined_at(&turn, 0, &hidden.collect::<Vec<_>>())) == 0);
    }

    #[test]
    fn poison_and_missing_images_move_nothing() {
        let Turn { avatar, nodes, mut frames, mut views, .. } = turn();
        frames[3].translations[7] = DVec3::NAN;
        frames[4].translations.clear();
        assert!(remember_outlines(&mut frames, &views, &avatar, &nodes) < 1e-9);
        let poisoned = frames.iter().flat_map(|frame| &frame.translations).filter(|by| !by.is_finite()).count();
        assert_eq!((poisoned, frames[4].translations.len()), (1, 0));
        views.clear();
        assert!(remember_outlines(&mut frames, &views, &avatar, &nodes) <= 0.0);
        assert!(remember_outlines(&mut [], &views, &avatar, &nodes) <= 0.0);
    }
}
