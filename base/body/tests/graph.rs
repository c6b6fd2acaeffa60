//! The deformation graph follows the surface.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, Part, ShapeParams, SurfaceGaussians, Template, build_graph, default_template,
    displacement, sample_surface, skin_mesh,
};
use glam::{DQuat, DVec3, Vec3};

fn graph_of(template: &Template, gaussians: usize, nodes: usize) -> (SurfaceGaussians, DeformationGraph) {
    let gaussians = sample_surface(template, gaussians, 3).unwrap();
    let graph = build_graph(template, &gaussians, nodes, DEFAULT_SIGMA2_M2).unwrap();
    check(&gaussians, &graph);
    (gaussians, graph)
}

/// Checks the invariants of any graph.
fn check(gaussians: &SurfaceGaussians, graph: &DeformationGraph) {
    let nodes = graph.nodes.len() as u32;
    assert_eq!(graph.node_gaussian.len(), nodes as usize);
    assert_eq!(graph.neighbors.len(), nodes as usize);
    assert_eq!(graph.gaussian_nodes.len(), gaussians.len());
    assert_eq!(graph.gaussian_weights.len(), gaussians.len());
    assert!(graph.neighbors.iter().chain(&graph.gaussian_nodes).flatten().all(|&node| node < nodes));
    for weights in &graph.gaussian_weights {
        assert!(weights.iter().all(|w| *w >= 0.0) && (weights.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{weights:?}");
    }
    for (node, &gaussian) in graph.node_gaussian.iter().enumerate() {
        assert_eq!(graph.nodes[node], gaussians.positions[gaussian as usize]);
        assert_eq!(graph.gaussian_nodes[gaussian as usize][0], node as u32);
    }
}

#[test]
fn on_a_flat_square_the_graph_is_what_a_plain_search_finds() {
    let (gaussians, graph) = graph_of(&common::square(), 3000, 60);
    assert_eq!(graph.nodes.len(), 60);
    // Farthest points: no two nodes closer than half the even spacing.
    let spacing = (1.0f32 / 60.0).sqrt();
    for (i, a) in graph.nodes.iter().enumerate() {
        assert!(graph.nodes[..i].iter().all(|b| a.distance(*b) > 0.6 * spacing));
        assert!(
            graph.neighbors[i]
                .iter()
                .all(|&other| other as usize != i && graph.nodes[other as usize].distance(*a) < 3.2 * spacing)
        );
    }
    for (i, p) in gaussians.positions.iter().enumerate() {
        let mut plain: Vec<f32> = graph.nodes.iter().map(|node| node.distance(*p)).collect();
        plain.sort_by(f32::total_cmp);
        let found = graph.gaussian_nodes[i].map(|node| graph.nodes[node as usize].distance(*p));
        // Ways over the links are a little longer than straight ones, so near ties may swap.
        assert!((0..4).all(|k| found[k] < plain[k] * 1.12 + 0.01), "{found:?} {:?}", &plain[..4]);
        let raw = found.map(|d| (-f64::from(d).powi(2) / DEFAULT_SIGMA2_M2).exp());
        let sum: f64 = raw.iter().sum();
        if sum > 1e-30 {
            for (weight, raw) in graph.gaussian_weights[i].iter().zip(raw) {
                assert!((f64::from(*weight) - raw / sum).abs() < 1e-4, "Eq. 2");
            }
        }
    }
}

#[test]
fn a_tiny_sigma_does_not_divide_by_zero() {
    let gaussians = sample_surface(&common::square(), 500, 3).unwrap();
    check(&gaussians, &build_graph(&common::square(), &gaussians, 20, 1e-6).unwrap());
    check(&gaussians, &build_graph(&common::square(), &gaussians, 20, 1e12).unwrap());
}

/// Two plates 5 mm apart, face to face, joined by a bend at one end.
#[test]
fn facing_plates_are_linked_through_the_bend_only() {
    let length = 0.4;
    let hairpin = common::sheet(81, 21, |u, v| {
        let along = u * (2.0 * length + 0.008);
        let (x, z) = match along {
            s if s <= length => (s, 0.0),
            s if s >= length + 0.008 => (2.0 * length + 0.008 - s, 0.005),
            s => (length + 0.003 * ((s - length) / 0.008 * std::f32::consts::PI).sin(), 0.005 * (s - length) / 0.008),
        };
        Vec3::new(x, v * 0.2, z)
    });
    let (gaussians, graph) = graph_of(&hairpin, 4000, 120);
    let upper = |p: Vec3| p.z > 0.0025;
    for (node, neighbors) in graph.neighbors.iter().enumerate() {
        let p = graph.nodes[node];
        for &other in neighbors {
            let q = graph.nodes[other as usize];
            assert!(upper(p) == upper(q) || p.x.min(q.x) > length - 0.08, "{p} and {q} are glued");
        }
    }
    for (p, nodes) in gaussians.positions.iter().zip(&graph.gaussian_nodes) {
        let glued = nodes.iter().any(|&node| upper(graph.nodes[node as usize]) != upper(*p));
        assert!(!glued || p.x > length - 0.1, "{p} hangs on the other plate");
    }
}

/// Two toes: side by side, same normals, one millimetre apart.
#[test]
fn a_narrow_gap_is_not_bridged() {
    let mut template = common::sheet(21, 21, |u, v| Vec3::new(u * 0.1, v * 0.1, 0.0));
    common::add_sheet(&mut template, 21, 21, |u, v| Vec3::new(0.101 + u * 0.1, v * 0.1, 0.0));
    let (gaussians, graph) = graph_of(&template, 3000, 60);
    let right = |p: Vec3| p.x > 0.1005;
    for (node, neighbors) in graph.neighbors.iter().enumerate() {
        assert!(neighbors.iter().all(|&other| right(graph.nodes[node]) == right(graph.nodes[other as usize])));
    }
    for (p, nodes) in gaussians.positions.iter().zip(&graph.gaussian_nodes) {
        assert!(nodes.iter().all(|&node| right(*p) == right(graph.nodes[node as usize])));
    }
}

#[test]
fn thighs_that_touch_are_not_glued() {
    let mut body = default_template(&ShapeParams::heavy_man()).unwrap();
    let mut pose = body.skeleton.rest_pose();
    for (name, angle) in [("LeftUpLeg", -0.16), ("RightUpLeg", 0.16)] {
        pose.joint_rotations[body.skeleton.joint(name).unwrap()] = DQuat::from_rotation_z(angle);
    }
    (body.positions, body.normals) = skin_mesh(&body, &pose);
    let crotch = body.skeleton.canonical_origins()[body.skeleton.joint("LeftUpLeg").unwrap()].y as f32 - 0.1;
    let (gaussians, graph) = graph_of(&body, 30_000, 1620);
    let part = |node: u32| gaussians.parts[graph.node_gaussian[node as usize] as usize];
    let left = |part| matches!(part, Part::LeftLeg | Part::LeftFoot);
    let right = |part| matches!(part, Part::RightLeg | Part::RightFoot);
    let (mut closest, mut legs) = (f32::MAX, 0);
    for (node, neighbors) in graph.neighbors.iter().enumerate() {
        let (a, at) = (graph.nodes[node], part(node as u32));
        if a.y > crotch - 0.08 || !left(at) && !right(at) {
            continue;
        }
        legs += 1;
        assert!(
            neighbors.iter().all(|&other| !(left(at) && right(part(other)) || right(at) && left(part(other)))),
            "{a}"
        );
        let across = (0..graph.nodes.len() as u32).filter(|&other| left(at) && right(part(other)));
        closest = across.map(|other| graph.nodes[other as usize].distance(a)).fold(closest, f32::min);
    }
    // The test means something: there are nodes of the other leg nearer than a node's own neighbours.
    assert!(legs > 200 && closest < 0.02, "{legs} {closest}");
    for (i, p) in gaussians.positions.iter().enumerate() {
        if p.y < crotch - 0.12 && left(gaussians.parts[i]) {
            assert!(graph.gaussian_nodes[i].iter().all(|&node| !right(part(node))), "{p}");
        }
    }
}

#[test]
fn the_body_has_1620_nodes_about_34_mm_apart_with_four_neighbours_each() {
    let (_, graph) = graph_of(&default_template(&ShapeParams::default()).unwrap(), 30_000, 1620);
    assert_eq!(graph.nodes.len(), 1620);
    let mut sum = 0.0;
    for (node, neighbors) in graph.neighbors.iter().enumerate() {
        let mut unique = neighbors.to_vec();
        unique.sort_unstable();
        unique.dedup();
        assert!(unique.len() == 4 && !unique.contains(&(node as u32)));
        sum +=
            neighbors.iter().map(|&other| graph.nodes[node].distance(graph.nodes[other as usize])).sum::<f32>() / 4.0;
    }
    let mean = sum / 1620.0;
    assert!((0.025..0.042).contains(&mean), "{mean}");
}

#[test]
fn tiny_and_torn_graphs_work() {
    for (gaussians, nodes) in [(1, 1), (1, 10), (4, 4), (50, 1), (50, 3), (3, 1620)] {
        let (gaussians, graph) = graph_of(&common::square(), gaussians, nodes);
        assert_eq!(graph.nodes.len(), nodes.min(gaussians.len()));
    }
    let (_, single) = graph_of(&common::square(), 50, 1);
    assert!(
        single.neighbors == [[0; 4]]
            && single.gaussian_weights.iter().all(|w| w.map(f32::to_bits) == [1f32.to_bits(), 0, 0, 0])
    );
    // Five islands and three nodes: two islands hang on a node across the water.
    let mut islands = common::empty();
    for k in 0..5 {
        common::add_sheet(&mut islands, 4, 4, |u, v| Vec3::new(k as f32 + 0.3 * u, 0.3 * v, 0.0));
    }
    let (gaussians, graph) = graph_of(&islands, 200, 3);
    let island = |p: Vec3| p.x.floor() as i32;
    for (p, nodes) in gaussians.positions.iter().zip(&graph.gaussian_nodes) {
        let nearest = graph.nodes[nodes[0] as usize];
        assert!(island(nearest) == island(*p) || !graph.nodes.iter().any(|node| island(*node) == island(*p)));
    }
}

#[test]
fn bad_input_is_refused() {
    let square = common::square();
    let gaussians = sample_surface(&square, 100, 0).unwrap();
    let refused = |gaussians: &SurfaceGaussians, nodes, sigma2| {
        build_graph(&square, gaussians, nodes, sigma2).unwrap_err().to_string()
    };
    assert!(refused(&gaussians, 0, 0.001).contains("at least 1"));
    for sigma2 in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(refused(&gaussians, 5, sigma2).contains("must be positive"));
    }
    let mut poisoned = gaussians.clone();
    poisoned.positions[3].x = f32::INFINITY;
    assert!(refused(&poisoned, 5, 0.001).contains("not finite"));
    let mut foreign = gaussians;
    foreign.triangle[0] = 1_000_000;
    assert!(refused(&foreign, 5, 0.001).contains("sample its surface again"));
}

/// Gaussians grow with the surface once that is much longer than at rest, and no rigid motion makes them grow. A Gaussian
/// with one node of more than negligible weight has nothing to measure and keeps its size.
#[test]
fn gaussians_grow_with_a_surface_that_is_stretched() {
    const NODES: usize = 300;
    let (_, graph) = graph_of(&common::square(), 500, NODES);
    let at = |i: usize, translations: &[DVec3]| {
        displacement(&graph.nodes, translations, graph.gaussian_nodes[i], graph.gaussian_weights[i])
    };
    let stretched = |by: f64| -> Vec<DVec3> { graph.nodes.iter().map(|p| p.as_dvec3() * (by - 1.0)).collect() };
    for i in 0..graph.gaussian_nodes.len() {
        let shifted = at(i, &vec![DVec3::new(0.1, -0.2, 0.3); NODES]);
        assert!((Vec3::from_slice(&shifted) - Vec3::new(0.1, -0.2, 0.3)).length() < 1e-6 && shifted[3] < 1e-6);
        for (by, growth) in [(0.2, 1.0), (1.2, 1.0), (2.0, 1.6), (4.0, 3.2), (50.0, 4.0)] {
            assert!((at(i, &stretched(by))[3] + 1.0 - growth).abs() < 1e-4, "{by}");
        }
        assert!(at(i, &[])[3].abs() < 1e-6, "nodes without a translation are at rest");
        assert!(at(i, &vec![DVec3::NAN; NODES])[3].abs() < 1e-6);
    }
    let alone = displacement(&graph.nodes, &stretched(4.0), [0, 1, 2, 3], [0.999, 0.001, 0.0, 0.0]);
    assert!(alone[3].abs() < 1e-6, "{alone:?}");
    let nowhere = displacement(&[], &[DVec3::X], [0; 4], [1.0, 0.0, 0.0, 0.0]);
    assert!((Vec3::from_slice(&nowhere) - Vec3::X).length() < 1e-6 && nowhere[3].abs() < 1e-6);
}
