//! `flyrig-bench stream`: bytes and run times of the person stream against what it loses, beside other forms of the same Gaussians.

pub mod arguments;
mod atlas;
mod forms;
pub mod receive;
mod score;
mod spz;
mod subject;
mod table;
mod take;

use anyhow::Result;
use flyrig_gpu::GpuContext;
use flyrig_report::{progress_bar, stop, write_whole};
use flyrig_viewer::PeopleScene;

use arguments::BenchStreamArgs;
use atlas::VideoAtlas;
use forms::{AvatarPoses, Form, Packed, Spz, StreamForm};
use score::FormTally;
use table::FormRow;
use take::CodedTake;

/// Runs the command.
pub fn stream(args: &BenchStreamArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let has_codec = atlas::has_codec();
    if !has_codec {
        eprintln!("the program ffmpeg was not found: no colours are coded as a video");
    }
    let mut rows = Vec::new();
    for folder in take::folders(args, gpu)? {
        for &pose in &args.pose {
            for &gaussians in &args.gaussians {
                if stop::requested() {
                    break;
                }
                let take = CodedTake::record(args, gpu, &folder, pose, gaussians)?;
                rows.extend(run(args, gpu, &take, has_codec)?);
                write(args, &rows)?;
            }
        }
    }
    print!("{}{}", table::table(&rows), table::exponents(&rows));
    println!(
        "{}; stream.md, .csv, .json and .svg in {}",
        gpu.fastest().adapter_name(),
        args.simulation.output.out.display()
    );
    Ok(())
}

fn write(args: &BenchStreamArgs, rows: &[FormRow]) -> Result<()> {
    let text = table::table(rows) + &table::exponents(rows);
    write_whole(&args.simulation.output.out.join("stream.md"), text.as_bytes())?;
    write_whole(&args.simulation.output.out.join("stream.csv"), table::csv(rows).as_bytes())?;
    write_whole(&args.simulation.output.out.join("stream.json"), &serde_json::to_vec_pretty(rows)?)?;
    write_whole(&args.simulation.output.out.join("stream.svg"), table::plot(rows).svg().as_bytes())?;
    Ok(())
}

/// Codes and scores a take in every form.
fn run(args: &BenchStreamArgs, gpu: &GpuContext, take: &CodedTake, has_codec: bool) -> Result<Vec<FormRow>> {
    let mut forms: Vec<Box<dyn Form>> = Vec::new();
    for &step in &args.steps {
        forms.push(Box::new(StreamForm::new(step)));
    }
    if let Some(avatar) = &take.avatar {
        forms.push(Box::new(AvatarPoses::new(avatar)));
    }
    forms.push(Box::new(Packed));
    forms.push(Box::new(Spz));
    for &crf in args.crf.iter().filter(|_| has_codec) {
        forms.push(Box::new(VideoAtlas::new(crf, take)?));
    }
    let mut scene = PeopleScene::new(&gpu.fastest())?;
    let bar = progress_bar((forms.len() * take.kept.len()) as u64, "bench stream");
    let mut rows = Vec::new();
    for form in &mut forms {
        bar.set_message(format!("{}: {}", take.name, form.name()));
        let mut tally = FormTally::new(take.cameras.len());
        for (at, kept) in take.kept.iter().enumerate() {
            bar.inc(1);
            let coded = form.code(at, kept)?;
            if stop::requested() {
                bar.finish_and_clear();
                return Ok(rows);
            }
            if !kept.views.is_empty() {
                tally.add(take, kept, &coded, &mut scene)?;
            }
        }
        rows.push(tally.row(take, form.name()));
    }
    bar.finish_and_clear();
    Ok(rows)
}
