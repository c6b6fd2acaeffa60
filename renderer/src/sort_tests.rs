//! The sort and the scan against the standard library's, on this machine's adapter.

use bytemuck::bytes_of;
use flyrig_gpu::{AdapterChoice, GpuContext};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use wgpu::ComputePassDescriptor;

use super::*;
use crate::constants::Constants;
use crate::raster_kernels::RasterShape;

fn sort_on_gpu(gpu: &GpuContext, sort: &mut RadixSort, scan: &Scan, keys: &[u32]) -> Vec<[u32; 2]> {
    sort.grow(gpu, keys.len()).unwrap();
    let elements: Vec<[u32; 2]> = keys.iter().copied().zip(0..).map(|(key, i)| [key, i]).collect();
    sort.input().write(gpu, &elements);
    let table = [sort.shape.table_len(), 0, 0, 0];
    let of_passes: Vec<SortPass> =
        (0..sort.shape.digit_passes).map(|index| SortPass::new(keys.len() as u32, index)).collect();
    let mut values = vec![bytes_of(&table)];
    values.extend(of_passes.iter().map(bytes_of));
    let constants = Constants::new(gpu, &values.iter().map(|value| value.len()).collect::<Vec<_>>()).unwrap();
    let passes: Vec<_> = (1..=sort.shape.digit_passes as usize).map(|i| constants.get(i)).collect();
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    constants.encode(gpu, &mut encoder, &values);
    let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
    sort.encode(gpu, &mut pass, scan, &passes, &constants.get(0));
    drop(pass);
    gpu.queue.submit([encoder.finish()]);
    let valid = sort.valid().read(gpu).unwrap()[0] as usize;
    sort.output().read(gpu).unwrap()[..valid].to_vec()
}

/// The documented order, by the standard library's stable sort.
fn expected(shape: SortShape, keys: &[u32]) -> Vec<[u32; 2]> {
    let mut kept: Vec<[u32; 2]> =
        keys.iter().copied().zip(0..).filter(|(key, _)| *key != INVALID_KEY).map(|(key, i)| [key, i]).collect();
    let smallest = kept.iter().map(|e| e[0]).min().unwrap_or(0);
    let largest = kept.iter().map(|e| e[0]).max().unwrap_or(0);
    let bits = 32 - (largest - smallest).leading_zeros();
    let shift = bits.saturating_sub(shape.digit_bits * shape.digit_passes);
    kept.sort_by_key(|e| (e[0] - smallest) >> shift);
    kept
}

#[test]
fn sorting_is_a_stable_permutation_for_random_and_adversarial_keys() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut rng = StdRng::seed_from_u64(6);
    let depth = |z: f32| z.to_bits();
    for shape in [RasterShape::SOFTWARE.sort, RasterShape::HARDWARE.sort] {
        let scan = Scan::new(&gpu, shape.chunks).unwrap();
        let mut sort = RadixSort::new(&gpu, 0, shape).unwrap();
        let mut check = |name: &str, keys: Vec<u32>| {
            let sorted = sort_on_gpu(&gpu, &mut sort, &scan, &keys);
            assert!(sorted == expected(shape, &keys), "{name}, {shape:?}, {} keys", keys.len());
            let again = sort_on_gpu(&gpu, &mut sort, &scan, &keys);
            assert!(sorted == again, "{name}: two runs differ");
        };
        check("none", vec![]);
        check("one", vec![7]);
        check("one, not valid", vec![INVALID_KEY]);
        check("all not valid", vec![INVALID_KEY; 1000]);
        for count in [31, 1000, 65_537, 115_000, 200_000] {
            check("random u32", (0..count).map(|_| rng.random::<u32>()).collect());
            check("all equal", vec![depth(2.5); count]);
            check("ascending", (0..count).map(|i| depth(1.0 + i as f32 * 1e-5)).collect());
            check("descending", (0..count).rev().map(|i| depth(1.0 + i as f32 * 1e-5)).collect());
            check("two values in turn", (0..count).map(|i| depth([3.0, 2.0][i % 2])).collect());
            check("depths", (0..count).map(|_| depth(rng.random_range(2.0..4.0))).collect());
            let with_nan = |i: usize| if i.is_multiple_of(3) { INVALID_KEY } else { depth(3.0 - i as f32 * 1e-6) };
            check("a third not valid", (0..count).map(with_nan).collect());
            // NaN depths never reach the sort as such, but would only be large keys.
            check("NaN bits", (0..count).map(|i| [depth(f32::NAN), depth(1.0), depth(2.0)][i % 3]).collect());
            check("far outlier", (0..count).map(|i| depth(if i == 5 { 9e8 } else { 0.06 + i as f32 })).collect());
        }
    }
}

#[test]
fn the_scan_is_the_running_sum() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut rng = StdRng::seed_from_u64(7);
    let scan = Scan::new(&gpu, 64).unwrap();
    let total = StorageBuffer::<u32>::zeroed(&gpu, "total", 1).unwrap();
    for length in [0usize, 1, 63, 64, 65, 10_000, 1_036_800] {
        let content: Vec<u32> = (0..length).map(|_| rng.random_range(0..1000)).collect();
        let values = StorageBuffer::from_slice(&gpu, "values", &content).unwrap();
        let constants = Constants::new(&gpu, &[size_of::<[u32; 4]>()]).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        constants.encode(&gpu, &mut encoder, &[bytes_of(&[length as u32, 0, 0, 0])]);
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        scan.encode(&gpu, &mut pass, &constants.get(0), &values, &total);
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        let mut sum = 0;
        let mut expected = Vec::new();
        for value in content {
            expected.push(sum);
            sum += value;
        }
        assert!(values.read(&gpu).unwrap() == expected, "length {length}");
        assert_eq!(total.read(&gpu).unwrap()[0], sum);
    }
}
