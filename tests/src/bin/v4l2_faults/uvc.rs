//! Emulated USB camera: a UVC device that speaks USB/IP to the kernel's virtual host controller, so that the real `uvcvideo`
//! driver handles it. It can be unplugged, stop sending, and send truncated images.

use std::{
    collections::VecDeque,
    fs,
    io::{self, Cursor, Read, Write},
    os::{fd::AsRawFd as _, unix::net::UnixStream},
    sync::{
        Arc, Condvar, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::{self, Builder, JoinHandle},
    time::{Duration, Instant},
};

use flyrig_types::{lock, wait_timeout};

const ATTACH: &str = "/sys/devices/platform/vhci_hcd.0/attach";
const WIDTH: u16 = 640;
const HEIGHT: u16 = 360;
const FRAME_BYTES: u32 = WIDTH as u32 * HEIGHT as u32 * 2;
const PERIOD: Duration = Duration::from_micros(33_333);
/// Frame intervals of 30 and 15 frames per second, in units of 100 ns.
const INTERVALS: [u32; 2] = [333_333, 666_666];

/// Faults that tests inject while a camera streams.
#[derive(Debug, Default)]
pub struct Knobs {
    /// Whether the camera stops sending.
    pub silent: AtomicBool,
    /// Number of the next images that are truncated in the middle.
    pub cut: AtomicU64,
}

#[derive(Debug)]
struct Shared {
    knobs: Arc<Knobs>,
    out: Mutex<UnixStream>,
    /// Pending transfers: the kernel's sequence number, and the capacity in bytes.
    waiting: Mutex<VecDeque<([u8; 4], usize)>>,
    changed: Condvar,
    gone: AtomicBool,
}

/// Plugged-in camera; dropping it unplugs it.
#[derive(Debug)]
pub struct UvcCamera {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl UvcCamera {
    /// Plugs a camera into a port of the virtual controller.
    pub fn plug(port: usize, serial: &str, knobs: Arc<Knobs>, pictures: Arc<Vec<Vec<u8>>>) -> io::Result<Self> {
        let (ours, kernels) = UnixStream::pair()?;
        // Port, socket, device number and speed; 3 stands for USB 2.
        fs::write(ATTACH, format!("{port} {} {} 3", kernels.as_raw_fd(), port + 1))?;
        let requests = ours.try_clone()?;
        let shared = Arc::new(Shared {
            knobs,
            out: Mutex::new(ours),
            waiting: Mutex::default(),
            changed: Condvar::new(),
            gone: AtomicBool::new(false),
        });
        let (for_requests, for_images) = (Arc::clone(&shared), Arc::clone(&shared));
        let serial = serial.to_owned();
        let threads = vec![
            Builder::new().name("uvc requests".to_owned()).spawn(move || {
                // Ends when the camera is unplugged.
                let _ = answer(requests, &for_requests, &serial);
                for_requests.gone.store(true, Ordering::Relaxed);
                for_requests.changed.notify_all();
            })?,
            Builder::new().name("uvc images".to_owned()).spawn(move || {
                let _ = send_images(&for_images, &pictures);
            })?,
        ];
        Ok(Self { shared, threads })
    }
}

impl Drop for UvcCamera {
    fn drop(&mut self) {
        self.shared.gone.store(true, Ordering::Relaxed);
        let _ = lock(&self.shared.out).shutdown(std::net::Shutdown::Both);
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Returns JPEG images of a moving bar.
pub fn pictures() -> Vec<Vec<u8>> {
    let picture = |n: u32| {
        let (width, height) = (u32::from(WIDTH), u32::from(HEIGHT));
        let image = image::RgbImage::from_fn(width, height, |x, y| {
            let bar = (x + n * 20) % width < 60;
            image::Rgb(if bar { [230, 200, 40] } else { [(x / 3) as u8, (y / 2) as u8, 90] })
        });
        let mut bytes = Cursor::new(Vec::new());
        // Writing to memory cannot fail.
        let _ = image.write_to(&mut bytes, image::ImageFormat::Jpeg);
        bytes.into_inner()
    };
    (0..8).map(picture).collect()
}

fn number(bytes: &[u8]) -> u32 {
    bytes.try_into().map_or(0, u32::from_be_bytes)
}

/// Completes a transfer.
fn complete(out: &mut UnixStream, sequence: [u8; 4], status: i32, length: usize, data: &[u8]) -> io::Result<()> {
    let mut reply = vec![0; 48];
    reply[3] = 3;
    reply[4..8].copy_from_slice(&sequence);
    reply[20..24].copy_from_slice(&status.to_be_bytes());
    reply[24..28].copy_from_slice(&(length as u32).to_be_bytes());
    reply.extend_from_slice(data);
    out.write_all(&reply)
}

fn answer(mut requests: UnixStream, shared: &Shared, serial: &str) -> io::Result<()> {
    const UNLINK: u32 = 2;
    const PIPE: i32 = -32;
    let mut device = Device::new(serial);
    loop {
        let mut head = [0; 48];
        requests.read_exact(&mut head)?;
        let mut sequence = [0; 4];
        sequence.copy_from_slice(&head[4..8]);
        if number(&head[..4]) == UNLINK {
            let mut waiting = lock(&shared.waiting);
            let before = waiting.len();
            waiting.retain(|(other, _)| *other != head[20..24]);
            let found = waiting.len() < before;
            let mut reply = [0; 48];
            reply[3] = 4;
            reply[4..8].copy_from_slice(&sequence);
            let status: i32 = if found { -104 } else { 0 };
            reply[20..24].copy_from_slice(&status.to_be_bytes());
            lock(&shared.out).write_all(&reply)?;
            continue;
        }
        let (is_in, endpoint, length) =
            (number(&head[12..16]) != 0, number(&head[16..20]), number(&head[24..28]) as usize);
        if endpoint == 1 && is_in {
            lock(&shared.waiting).push_back((sequence, length));
            shared.changed.notify_all();
            continue;
        }
        let mut sent = vec![0; if is_in { 0 } else { length.min(4096) }];
        requests.read_exact(&mut sent)?;
        let mut setup = [0; 8];
        setup.copy_from_slice(&head[40..48]);
        let mut out = lock(&shared.out);
        match device.control(setup, &sent) {
            Some(mut reply) if is_in => {
                reply.truncate(usize::from(u16::from_le_bytes([setup[6], setup[7]])));
                complete(&mut out, sequence, 0, reply.len(), &reply)?;
            }
            Some(_) => complete(&mut out, sequence, 0, length, &[])?,
            None => complete(&mut out, sequence, PIPE, 0, &[])?,
        }
    }
}

fn send_images(shared: &Shared, pictures: &[Vec<u8>]) -> io::Result<()> {
    let (mut next, mut toggle) = (Instant::now(), 0);
    for picture in pictures.iter().cycle() {
        let mut payload = vec![2, 0x82 | toggle];
        toggle ^= 1;
        let is_cut =
            shared.knobs.cut.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1)).is_ok();
        let whole = picture.len();
        payload.extend_from_slice(&picture[..if is_cut { whole / 2 } else { whole }]);
        if payload.len() % 512 == 0 {
            // A transfer ends with a short packet.
            payload.push(0);
        }
        let now = Instant::now();
        thread::sleep(next.saturating_duration_since(now));
        next = (next + PERIOD).max(now);
        let mut rest = payload.as_slice();
        while !rest.is_empty() {
            let mut waiting = lock(&shared.waiting);
            while waiting.is_empty() || shared.knobs.silent.load(Ordering::Relaxed) {
                if shared.gone.load(Ordering::Relaxed) {
                    return Ok(());
                }
                waiting = wait_timeout(&shared.changed, waiting, PERIOD);
            }
            let Some((sequence, room)) = waiting.pop_front() else { continue };
            let (now, later) = rest.split_at(rest.len().min(room));
            // Hold the lock: no thread may report a transfer as complete before it is.
            complete(&mut lock(&shared.out), sequence, 0, now.len(), now)?;
            drop(waiting);
            rest = later;
        }
        if shared.gone.load(Ordering::Relaxed) {
            return Ok(());
        }
    }
    Ok(())
}

/// Control endpoint of the device.
struct Device {
    strings: [String; 3],
    probe: Vec<u8>,
    /// Automatic exposure mode and exposure in 0.1 ms.
    exposure: (u8, u32),
}

impl Device {
    fn new(serial: &str) -> Self {
        let mut device = Self {
            strings: ["flyrig".to_owned(), format!("Test Camera {serial}"), serial.to_owned()],
            probe: Vec::new(),
            exposure: (8, 250),
        };
        device.negotiate(&[]);
        device
    }

    /// Accepts the host's requested values that the camera supports.
    fn negotiate(&mut self, wanted: &[u8]) {
        let interval = wanted.get(4..8).map_or(0, |bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
        let interval = if interval == INTERVALS[1] { INTERVALS[1] } else { INTERVALS[0] };
        let format = if wanted.get(2) == Some(&2) { 2 } else { 1 };
        self.probe = vec![0, 0, format, 1];
        self.probe.extend(interval.to_le_bytes());
        self.probe.resize(18, 0);
        self.probe.extend(FRAME_BYTES.to_le_bytes());
        self.probe.extend((FRAME_BYTES + 12).to_le_bytes());
    }

    fn control(&mut self, setup: [u8; 8], sent: &[u8]) -> Option<Vec<u8>> {
        let [kind, request, low, high, interface, entity, ..] = setup;
        match (kind, request) {
            (0x80, 6) => match high {
                1 => Some(DEVICE.to_vec()),
                2 => Some(configuration()),
                3 if low == 0 => Some(vec![4, 3, 9, 4]),
                3 => {
                    let text = self.strings.get(usize::from(low) - 1)?;
                    let mut reply = vec![2 + 2 * text.len() as u8, 3];
                    reply.extend(text.encode_utf16().flat_map(u16::to_le_bytes));
                    Some(reply)
                }
                _ => None,
            },
            (0x80, 0) => Some(vec![0, 0]),
            (0..=2, _) => Some(Vec::new()),
            // Video streaming: probe and commit.
            (0xa1, 0x85) if interface == 1 => Some(vec![26, 0]),
            (0xa1, 0x86) if interface == 1 => Some(vec![3]),
            (0xa1, _) if interface == 1 => Some(self.probe.clone()),
            (0x21, 1) if interface == 1 => {
                self.negotiate(sent);
                Some(Vec::new())
            }
            // Camera terminal: exposure mode and time.
            (0xa1, 0x86) if entity == 1 => Some(vec![3]),
            (0xa1, 0x85) if entity == 1 => Some(vec![if high == 2 { 1 } else { 4 }, 0]),
            (0xa1, what) if entity == 1 && high == 2 => Some(vec![if what == 0x84 {
                9
            } else if what == 0x81 {
                self.exposure.0
            } else {
                8
            }]),
            (0xa1, what) if entity == 1 && high == 4 => {
                let value: u32 = match what {
                    0x81 => self.exposure.1,
                    0x82 => 3,
                    0x83 => 2047,
                    0x84 => 1,
                    _ => 250,
                };
                Some(value.to_le_bytes().to_vec())
            }
            (0x21, 1) if entity == 1 && high == 2 => {
                self.exposure.0 = *sent.first()?;
                Some(Vec::new())
            }
            (0x21, 1) if entity == 1 && high == 4 => {
                self.exposure.1 = u32::from_le_bytes(sent.get(..4)?.try_into().ok()?);
                Some(Vec::new())
            }
            _ => None,
        }
    }
}

const DEVICE: [u8; 18] = [18, 1, 0, 2, 0xef, 2, 1, 64, 0x6b, 0x1d, 5, 1, 0, 1, 1, 2, 3, 1];

/// Returns the descriptor of one frame size at two rates, for MJPEG (7) or uncompressed (5) frames.
fn frame(kind: u8) -> Vec<u8> {
    let mut bytes = vec![34, 0x24, kind, 1, 0];
    bytes.extend([WIDTH, HEIGHT].into_iter().flat_map(u16::to_le_bytes));
    let numbers = [FRAME_BYTES * 8 * 15, FRAME_BYTES * 8 * 30, FRAME_BYTES, INTERVALS[0]];
    bytes.extend(numbers.into_iter().flat_map(u32::to_le_bytes));
    bytes.push(2);
    bytes.extend(INTERVALS.into_iter().flat_map(u32::to_le_bytes));
    bytes
}

fn configuration() -> Vec<u8> {
    let mut streaming = vec![15, 0x24, 1, 2, 0, 0, 0x81, 0, 2, 0, 0, 0, 1, 0, 0];
    streaming.extend([11, 0x24, 6, 1, 1, 1, 1, 0, 0, 0, 0]);
    streaming.extend(frame(7));
    streaming.extend([27, 0x24, 4, 2, 1]);
    streaming.extend(b"YUY2\x00\x00\x10\x00\x80\x00\x00\xaa\x00\x38\x9b\x71");
    streaming.extend([16, 1, 0, 0, 0, 0]);
    streaming.extend(frame(5));
    let length = (streaming.len() as u16).to_le_bytes();
    streaming[4..6].copy_from_slice(&length);
    // Header, camera terminal with exposure mode and time, output terminal.
    let mut control = vec![13, 0x24, 1, 0, 1, 40, 0, 0, 0x6c, 0xdc, 2, 1, 1];
    control.extend([18, 0x24, 2, 1, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0x0a, 0, 0]);
    control.extend([9, 0x24, 3, 2, 1, 1, 0, 1, 0]);
    let mut all = vec![9, 2, 0, 0, 2, 1, 0, 0x80, 50];
    all.extend([8, 11, 0, 2, 14, 3, 0, 2]);
    all.extend([9, 4, 0, 0, 0, 14, 1, 0, 2]);
    all.extend(control);
    all.extend([9, 4, 1, 0, 1, 14, 2, 0, 0]);
    all.extend(streaming);
    all.extend([7, 5, 0x81, 2, 0, 2, 0]);
    let length = (all.len() as u16).to_le_bytes();
    all[2..4].copy_from_slice(&length);
    all
}
