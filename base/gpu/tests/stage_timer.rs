//! Stage times without waits.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use std::time::{Duration, Instant};

use flyrig_gpu::{AdapterChoice, ComputeKernel, GpuContext, StageTimer, StorageBuffer};

const WGSL: &str = "
@group(0) @binding(0) var<storage, read_write> values: array<u32>;
@compute @workgroup_size(1) fn main() {
    for (var i = 0u; i < 20000u; i++) { values[i % 4u] += i; }
}
";

#[test]
fn stages_arrive_in_order_and_lie_within_the_frame() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let kernel = ComputeKernel::new(&gpu, "work", &[WGSL], "main");
    let values = StorageBuffer::<u32>::zeroed(&gpu, "values", 4).unwrap();
    let group = kernel.bind(&gpu, &[values.raw().as_entire_binding()]);
    let mut timer = StageTimer::new(&gpu, 2);
    let start = Instant::now();
    let frame = |timer: &mut StageTimer| {
        // A stage may end in another encoder than the one in which it began.
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        timer.begin(&mut encoder);
        timer.mark(&mut encoder, "nothing");
        gpu.queue.submit([encoder.finish()]);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(1, 1, 1);
        drop(pass);
        timer.mark(&mut encoder, "work");
        timer.mark(&mut encoder, "one mark too many");
        timer.finish(&mut encoder);
        gpu.queue.submit([encoder.finish()]);
    };
    frame(&mut timer);
    gpu.wait().unwrap();
    let elapsed = start.elapsed();
    let stages = timer.collect();
    println!("{} in {elapsed:?}: {stages:?}", gpu.adapter_name());
    if !timer.is_supported() {
        assert!(stages.is_empty());
        return;
    }
    let names: Vec<_> = stages.iter().map(|stage| stage.name).collect();
    assert_eq!(names, ["nothing", "work"]);
    let total: Duration = stages.iter().map(|stage| stage.time).sum();
    assert!(stages[1].time > Duration::ZERO && total <= elapsed, "{total:?} of {elapsed:?}");
    assert!(timer.collect().is_empty(), "every frame comes once");

    // Encoders that are dropped take no frame away.
    for _ in 0..10 {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        timer.begin(&mut encoder);
        timer.finish(&mut encoder);
    }

    // Frames beyond those under way are not measured; the others arrive, and later ones are measured again.
    for _ in 0..20 {
        frame(&mut timer);
    }
    gpu.wait().unwrap();
    let arrived = timer.collect().len();
    assert!(arrived >= 2 && arrived.is_multiple_of(2) && arrived <= 40, "{arrived}");
    frame(&mut timer);
    gpu.wait().unwrap();
    assert_eq!(timer.collect().len(), 2);
    gpu.check().unwrap();
}
