//! The sort and the scan against the standard library's, on this machine's adapter.

use bytemuck::bytes_of;
use flyrig_gpu::{AdapterChoice, GpuContext};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use wgpu::ComputePassDescriptor;

use super::*;
use crate::constants::Constants;

fn sort_on_gpu(gpu: &GpuContext, sort: &mut RadixSort, scan: &Scan, keys: &[u32], kind: Keys) -> Vec<[u32; 2]> {
    sort.grow(gpu, keys.len()).unwrap();
    let elements: Vec<[u32; 2]> = keys.iter().copied().zip(0..).map(|(key, i)| [key, i]).collect();
    sort.input().write(gpu, &elements);
    sort.valid().write(gpu, &[keys.len() as u32]);
    let table = [table_len(keys.len()), 0, 0, 0];
    let of_passes: Vec<SortPass> = (0..kind.passes()).map(|index| SortPass::new(keys.len(), kind, index)).collect();
    let mut values = vec![bytes_of(&table)];
    values.extend(of_passes.iter().map(bytes_of));
    let constants = Constants::new(gpu, &values.iter().map(|value| value.len()).collect::<Vec<_>>()).unwrap();
    let passes: Vec<_> = (1..=kind.passes() as usize).map(|i| constants.get(i)).collect();
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    constants.encode(gpu, &mut encoder, &values);
    sort.prepare(&mut encoder);
    let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
    sort.encode(gpu, &mut pass, ((blocks(keys.len()), 1).into(), kind), scan, &passes, &constants.get(0));
    drop(pass);
    gpu.queue.submit([encoder.finish()]);
    let valid = sort.valid().read(gpu).unwrap()[0] as usize;
    sort.output(kind).read(gpu).unwrap()[..valid].to_vec()
}

/// The documented order, by the standard library's stable sort.
fn expected(keys: &[u32], kind: Keys) -> Vec<[u32; 2]> {
    let mut elements: Vec<[u32; 2]> = keys.iter().copied().zip(0..).map(|(key, i)| [key, i]).collect();
    if kind != Keys::Scaled {
        elements.sort_by_key(|e| e[0]);
        return elements;
    }
    elements.retain(|e| e[0] != INVALID_KEY);
    let smallest = elements.iter().map(|e| e[0]).min().unwrap_or(0);
    let largest = elements.iter().map(|e| e[0]).max().unwrap_or(0);
    let bits = 32 - (largest - smallest).leading_zeros();
    let shift = bits.saturating_sub(KEY_BITS);
    elements.sort_by_key(|e| (e[0] - smallest) >> shift);
    elements
}

#[test]
fn sorting_is_a_stable_permutation_for_random_and_adversarial_keys() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut rng = StdRng::seed_from_u64(6);
    let depth = |z: f32| z.to_bits();
    let scan = Scan::new(&gpu).unwrap();
    let mut sort = RadixSort::new(&gpu, 0).unwrap();
    let mut check = |name: &str, keys: Vec<u32>| {
        let sorted = sort_on_gpu(&gpu, &mut sort, &scan, &keys, Keys::Scaled);
        assert!(sorted == expected(&keys, Keys::Scaled), "{name}, {} keys", keys.len());
        let again = sort_on_gpu(&gpu, &mut sort, &scan, &keys, Keys::Scaled);
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

#[test]
fn keys_below_a_number_are_sorted_as_they_are() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut rng = StdRng::seed_from_u64(8);
    let scan = Scan::new(&gpu).unwrap();
    let mut sort = RadixSort::new(&gpu, 0).unwrap();
    for (end, passes) in [(1, 1), (2, 1), (256, 1), (257, 2), (8160, 2), (65_536, 2), (65_537, 3), (u32::MAX, 4)] {
        let kind = Keys::Below(end);
        assert_eq!(kind.passes(), passes, "{end}");
        for count in [0, 1, 1023, 1024, 1025, 50_000] {
            let keys: Vec<u32> = (0..count).map(|_| rng.random_range(0..end)).collect();
            let sorted = sort_on_gpu(&gpu, &mut sort, &scan, &keys, kind);
            assert!(sorted == expected(&keys, kind), "{count} keys below {end}");
        }
    }
}

#[test]
fn the_scan_is_the_running_sum() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut rng = StdRng::seed_from_u64(7);
    let scan = Scan::new(&gpu).unwrap();
    let total = StorageBuffer::<u32>::zeroed(&gpu, "total", 1).unwrap();
    for length in [0usize, 1, 63, 64, 65, 10_000, 1_036_800] {
        // The longest one's sum would overflow.
        let most = if length > 100_000 { 20_000 } else { 1000 };
        let content: Vec<u32> = (0..length).map(|_| rng.random_range(0..most)).collect();
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
            sum = (sum + value).min((1 << 31) - 1);
        }
        assert!(values.read(&gpu).unwrap() == expected, "length {length}");
        assert_eq!(total.read(&gpu).unwrap()[0], sum);
    }
}
