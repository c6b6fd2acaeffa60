//! Cache of bind groups by pipeline and bound buffer ranges.

use std::{
    collections::HashMap,
    sync::{Mutex, atomic::Ordering},
};

use flyrig_types::lock;
use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindingResource, Buffer, BufferSize, ComputePipeline, Device,
};

use crate::objects::Counters;

/// Largest number of cached groups, beyond which the less recently used half is dropped. One person before eight cameras needs about 350.
const MOST: usize = 4096;

/// Pipeline and bound resources. Holds the objects themselves, so that no other object can get the same identity while the key
/// exists.
#[derive(Debug, PartialEq, Eq, Hash)]
struct Key {
    pipeline: ComputePipeline,
    ranges: Vec<(u32, Buffer, u64, Option<BufferSize>)>,
}

#[derive(Debug)]
struct Known {
    group: BindGroup,
    last_use: u64,
}

#[derive(Debug, Default)]
struct Cache {
    groups: HashMap<Key, Known>,
    uses: u64,
}

/// Cache of bind groups. A group is dropped with the first of its [`crate::StorageBuffer`]s, so that it keeps no unused memory
/// alive.
#[derive(Debug, Default)]
pub(crate) struct BindGroups(Mutex<Cache>);

impl BindGroups {
    /// Returns group 0 of `pipeline` with these resources at these bindings.
    pub fn get(
        &self,
        device: &Device,
        counters: &Counters,
        pipeline: &ComputePipeline,
        resources: &[(u32, BindingResource<'_>)],
    ) -> BindGroup {
        let create = || {
            counters.bind_groups.fetch_add(1, Ordering::Relaxed);
            let entries: Vec<_> = resources
                .iter()
                .map(|(binding, resource)| BindGroupEntry { binding: *binding, resource: resource.clone() })
                .collect();
            let layout = &pipeline.get_bind_group_layout(0);
            device.create_bind_group(&BindGroupDescriptor { label: None, layout, entries: &entries })
        };
        let range = |(binding, resource): &(u32, BindingResource<'_>)| match resource {
            BindingResource::Buffer(range) => Some((*binding, range.buffer.clone(), range.offset, range.size)),
            _ => None,
        };
        let Some(ranges) = resources.iter().map(range).collect() else { return create() };
        let key = Key { pipeline: pipeline.clone(), ranges };
        let mut cache = lock(&self.0);
        cache.uses += 1;
        let now = cache.uses;
        if let Some(known) = cache.groups.get_mut(&key) {
            known.last_use = now;
            return known.group.clone();
        }
        if cache.groups.len() >= MOST {
            cache.halve();
        }
        let group = create();
        cache.groups.insert(key, Known { group: group.clone(), last_use: now });
        group
    }

    /// Drops all groups that bind `buffer`.
    pub fn forget(&self, buffer: &Buffer) {
        lock(&self.0).groups.retain(|key, _| key.ranges.iter().all(|(_, bound, ..)| bound != buffer));
    }

    #[cfg(test)]
    pub fn len(&self) -> usize {
        lock(&self.0).groups.len()
    }
}

impl Cache {
    /// Drops the less recently used half.
    fn halve(&mut self) {
        let mut uses: Vec<u64> = self.groups.values().map(|known| known.last_use).collect();
        let middle = uses.len() / 2;
        let median = *uses.select_nth_unstable(middle).1;
        self.groups.retain(|_, known| known.last_use >= median);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AdapterChoice, ComputeKernel, GpuContext, StorageBuffer};

    const WGSL: &str = "
@group(0) @binding(0) var<storage, read_write> values: array<u32>;
@compute @workgroup_size(1) fn main() { values[0] += 1u; }
";

    #[test]
    fn groups_are_used_again_until_a_buffer_is_dropped() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let kernel = ComputeKernel::new(&gpu, "count", &[WGSL], "main");
        let [first, second] = [(); 2].map(|()| StorageBuffer::<u32>::zeroed(&gpu, "values", 4).unwrap());
        for _ in 0..3 {
            for buffer in [&first, &second] {
                let _ = kernel.bind(&gpu, &[buffer.raw().as_entire_binding()]);
            }
        }
        assert_eq!((gpu.objects().bind_groups, gpu.shared.bind_groups.len()), (2, 2));
        let clone = first.clone();
        drop(first);
        assert_eq!(gpu.shared.bind_groups.len(), 2, "the clone still shares the array");
        drop(clone);
        assert_eq!(gpu.shared.bind_groups.len(), 1);
    }

    #[test]
    fn the_number_of_groups_is_bounded_and_the_recent_ones_stay() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let kernel = ComputeKernel::new(&gpu, "count", &[WGSL], "main");
        let count = MOST as u64 + 10;
        let buffer = StorageBuffer::<u32>::zeroed(&gpu, "values", count as usize * 64).unwrap();
        let bind = |index: u64| {
            let size = BufferSize::new(16);
            let range = wgpu::BufferBinding { buffer: buffer.raw(), offset: index * 256, size };
            let _ = kernel.bind(&gpu, &[BindingResource::Buffer(range)]);
        };
        for index in 0..count {
            bind(0);
            bind(index);
        }
        assert!(gpu.shared.bind_groups.len() <= MOST / 2 + 11, "{}", gpu.shared.bind_groups.len());
        let made = gpu.objects().bind_groups;
        bind(0);
        bind(count - 1);
        assert_eq!(gpu.objects().bind_groups, made);
        bind(1);
        assert_eq!(gpu.objects().bind_groups, made + 1);
    }
}
