//! Prints the errors of calibrations against a known truth: `cargo run --release -p flyrig-calib --example compare_rigs
//! -- TRUTH FOUND...`, folders of calibrations.

use std::{error::Error, path::Path};

use flyrig_calib::{load_calibration, testing::rig_errors};

fn main() -> Result<(), Box<dyn Error>> {
    let folders: Vec<String> = std::env::args().skip(1).collect();
    let [truth, found @ ..] = folders.as_slice() else { return Err("name the truth and what was found".into()) };
    let load = |folder: &String| load_calibration(Path::new(folder), &|_| None);
    let truth = load(truth)?;
    println!("{:<24} {:>16} {:>18} {:>16}", "mean, largest of", "px", "degrees", "mm");
    for folder in found {
        let errors = rig_errors(&load(folder)?.cameras, &truth.cameras).ok_or("the cameras are not the same ones")?;
        let pair = |values: Vec<f64>, digits: usize| {
            let (mean, most) =
                (values.iter().sum::<f64>() / values.len() as f64, values.iter().copied().fold(0.0, f64::max));
            format!("{mean:.digits$}, {most:.digits$}")
        };
        let [px, deg, mm] = [
            pair(errors.iter().map(|error| error.px).collect(), 2),
            pair(errors.iter().map(|error| error.deg).collect(), 3),
            pair(errors.iter().map(|error| error.mm).collect(), 1),
        ];
        println!("{folder:<24} {px:>16} {deg:>18} {mm:>16}");
    }
    Ok(())
}
