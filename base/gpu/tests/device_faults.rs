//! A device that rejects a command or is out of memory gives an error; nothing panics.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use std::process::Command;

use flyrig_gpu::{AdapterChoice, GpuContext, GpuError, StorageBuffer};

#[test]
fn a_rejected_command_is_a_fault_of_the_device() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    assert!(gpu.check().is_ok());
    let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::STORAGE;
    let _ =
        gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size: 16, usage, mapped_at_creation: false });
    let fault = gpu.wait().unwrap_err();
    assert!(matches!(fault, GpuError::Rejected(_)) && fault.is_device_fault(), "{fault}");
    assert!(gpu.reopen().unwrap().wait().is_ok());
}

/// Address space of the process that exhausts it, KiB: enough to open a software adapter.
const LIMIT_KIB: u32 = 6_000_000;
/// Variable of that process: without a limit nothing would be exhausted.
const LIMITED: &str = "FLYRIG_TEST_LIMITED";

#[test]
#[cfg(target_os = "linux")]
fn a_full_memory_is_a_fault_of_the_device_and_no_panic() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    if !gpu.is_software() {
        return; // the limit is one of this process, not of the adapter
    }
    let child = Command::new("sh")
        .args(["-c", &format!("ulimit -v {LIMIT_KIB}; exec \"$0\" \"$@\"")])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "fills_the_memory", "--ignored", "--nocapture"])
        .env(LIMITED, "1")
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&child.stdout) + String::from_utf8_lossy(&child.stderr);
    assert!(child.status.success() && text.contains("1 passed"), "{text}");
}

#[test]
#[ignore = "run by the test above, in a process of limited memory"]
fn fills_the_memory() {
    const BYTES: usize = 1 << 27;
    if std::env::var_os(LIMITED).is_none() {
        return;
    }
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut held = Vec::new();
    let fault = loop {
        if let Err(fault) = gpu.check() {
            break fault;
        }
        assert!(held.len() < 100, "{} GiB were handed out", held.len() / 8);
        held.push(StorageBuffer::<[f32; 4]>::zeroed(&gpu, "filler", BYTES / 16));
    };
    assert!(matches!(fault, GpuError::OutOfMemory) && fault.is_device_fault(), "{fault}");
    drop(held);
    assert!(gpu.reopen().unwrap().wait().is_ok(), "there is room again");
}
