//! Uploads of constants within encoders, and reuse of bind groups.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use flyrig_gpu::{AdapterChoice, ComputeKernel, GpuContext, GpuTraffic, StorageBuffer, read_all};
use wgpu::{Buffer, CommandEncoder};

/// Kernel that writes `constants[1]` to element `constants[0]`.
const WGSL: &str = "
@group(0) @binding(0) var<storage, read> constants: vec2<u32>;
@group(0) @binding(1) var<storage, read_write> out: array<u32>;
@compute @workgroup_size(1) fn main() { out[constants.x] = constants.y; }
";

struct Writer {
    kernel: ComputeKernel,
    constants: StorageBuffer<u32>,
    out: StorageBuffer<u32>,
}

impl Writer {
    fn new(gpu: &GpuContext) -> Self {
        Self {
            kernel: ComputeKernel::new(gpu, "writer", &[WGSL], "main"),
            constants: StorageBuffer::zeroed(gpu, "constants", 2).unwrap(),
            out: StorageBuffer::zeroed(gpu, "out", 8).unwrap(),
        }
    }

    fn encode(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, place: u32, value: u32) {
        self.constants.encode_write(gpu, encoder, &[place, value]);
        let bound = [self.constants.raw(), self.out.raw()].map(Buffer::as_entire_binding);
        let group = self.kernel.bind(gpu, &bound);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.kernel.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(1, 1, 1);
    }
}

#[test]
fn each_dispatch_of_an_encoder_sees_its_own_constants() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let writer = Writer::new(&gpu);
    let mut counts = Vec::new();
    for round in 1..=30 {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for place in 0..8 {
            writer.encode(&gpu, &mut encoder, place, 100 * round + place);
        }
        // Recorded before, executed after: two encoders at once own different upload buffers.
        let mut later = gpu.device.create_command_encoder(&Default::default());
        writer.encode(&gpu, &mut later, 0, 7);
        // Never submitted, and so without any effect.
        writer.encode(&gpu, &mut gpu.device.create_command_encoder(&Default::default()), 1, 8);
        gpu.queue.submit([encoder.finish()]);
        let expected: Vec<u32> = (0..8).map(|place| 100 * round + place).collect();
        assert_eq!(writer.out.read(&gpu).unwrap(), expected);
        gpu.queue.submit([later.finish()]);
        assert_eq!(writer.out.read(&gpu).unwrap()[0], 7);
        counts.push(gpu.objects());
    }
    assert_eq!(counts[0].bind_groups, 1);
    // The dropped encoders' buffers are the only ones that are not used again: 30 of them, 16 are made at a time.
    assert!(counts[29].uploads <= 16 + 32, "{:?}", counts[29]);
    assert_eq!(counts[29].bind_groups, 1);
}

#[test]
fn threads_on_one_device_do_not_get_each_others_constants() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    std::thread::scope(|scope| {
        for thread in 0..4u32 {
            let gpu = gpu.clone();
            scope.spawn(move || {
                let writer = Writer::new(&gpu);
                for round in 0..40 {
                    let encoders: Vec<_> = (0..2u32)
                        .map(|half| {
                            let mut encoder = gpu.device.create_command_encoder(&Default::default());
                            for place in 0..4 {
                                let place = 4 * half + place;
                                writer.encode(&gpu, &mut encoder, place, 1000 * thread + 10 * round + place);
                            }
                            encoder
                        })
                        .collect();
                    // Not in the order in which they were recorded.
                    for encoder in encoders.into_iter().rev() {
                        gpu.queue.submit([encoder.finish()]);
                    }
                    let expected: Vec<u32> = (0..8).map(|place| 1000 * thread + 10 * round + place).collect();
                    assert_eq!(writer.out.read(&gpu).unwrap(), expected);
                }
            });
        }
    });
    gpu.check().unwrap();
    assert!(gpu.objects().uploads <= 64, "8 are under way at most for each thread: {:?}", gpu.objects());
}

#[test]
fn several_arrays_are_read_with_one_wait() {
    flyrig_gpu::testing::on_both(|gpu| {
        let contents = [vec![[1.0f32, 2.0]; 5], Vec::new(), vec![[3.0, 4.0], [5.0, 6.0]]];
        let make = |content: &Vec<[f32; 2]>| StorageBuffer::from_slice(gpu, "array", content).unwrap();
        let before = gpu.traffic();
        let arrays = contents.each_ref().map(make);
        assert_eq!(read_all(gpu, &arrays.each_ref()).unwrap(), contents);
        let (waits, bytes) = if gpu.is_on_processor() { (0, 0) } else { (1, 7 * 8) };
        let expected = GpuTraffic { dispatches: 0, waits, uploaded_bytes: bytes, read_bytes: bytes };
        assert_eq!(gpu.traffic().since(before), expected);
        assert!(read_all::<u32>(gpu, &[]).unwrap().is_empty());
    });
}
