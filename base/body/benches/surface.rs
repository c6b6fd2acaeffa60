//! Times what prepares the surface of a person: evenly spaced Gaussians, the graph with its links, the coarse subset. Prints how even
//! the spacing is beside.
//!
//! ```text
//! RAYON_NUM_THREADS=1 cargo bench -p flyrig-body --bench surface -- [RUNS]
//! ```

use std::time::Instant;

use flyrig_body::{
    BodyError, DEFAULT_GAUSSIAN_COUNT, DEFAULT_NODE_COUNT, DEFAULT_SIGMA2_M2, ShapeParams, build_graph, coarsen,
    default_template, sample_surface,
};

fn main() -> Result<(), BodyError> {
    // Cargo adds "--bench".
    let runs = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(9);
    let template = default_template(&ShapeParams::default())?;
    let mut times = [const { Vec::new() }; 3];
    let mut lap = |stage: usize, start: Instant| times[stage].push(start.elapsed().as_secs_f64() * 1e3);
    let mut scales = Vec::new();
    for _ in 0..runs {
        let start = Instant::now();
        let surface = sample_surface(&template, DEFAULT_GAUSSIAN_COUNT, 1)?;
        lap(0, start);
        let start = Instant::now();
        let graph = build_graph(&template, &surface, DEFAULT_NODE_COUNT, DEFAULT_SIGMA2_M2)?;
        lap(1, start);
        let start = Instant::now();
        let coarse = coarsen(&template, &surface, &graph, surface.len() / 4)?;
        lap(2, start);
        scales = surface.scale_m;
        assert!(coarse.gaussians.len() == scales.len() / 4, "a quarter of the Gaussians");
    }
    println!("{DEFAULT_GAUSSIAN_COUNT} Gaussians, {DEFAULT_NODE_COUNT} nodes, median of {runs}, milliseconds");
    for (name, times) in ["sample_surface", "build_graph", "coarsen"].iter().zip(&mut times) {
        times.sort_by(f64::total_cmp);
        println!("{name:16} {:8.1} (least {:.1})", times[times.len() / 2], times[0]);
    }
    let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / scales.len() as f64;
    let scale = mean(&mut scales.iter().map(|s| f64::from(*s)));
    let spread = mean(&mut scales.iter().map(|s| (f64::from(*s) - scale).powi(2))).sqrt();
    println!("scale {:.4} mm, standard deviation {:.4} mm", scale * 1e3, spread * 1e3);
    Ok(())
}
