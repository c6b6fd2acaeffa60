//! Small simulations for tests.

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator};

/// 128 x 128, two cameras, coarse textures.
pub fn small_config(seed: u64) -> SimConfig {
    let mut config = SimConfig { seed, width: 128, height: 128, texture_px: 128, ..SimConfig::default() };
    config.cameras.count = 2;
    config
}

pub fn simulator(config: &SimConfig) -> Simulator {
    Simulator::new(&GpuContext::new(&AdapterChoice::Best).unwrap(), config).unwrap()
}
