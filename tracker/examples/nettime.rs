//! Times the network.
use flyrig_tracker::PoseNet;
use std::time::Instant;
fn main() {
    let x = vec![0.4f32; 256 * 256 * 3];
    let mut nets = vec![("embedded".to_owned(), PoseNet::embedded().unwrap())];
    for p in std::env::args().skip(1) { nets.push((p.clone(), PoseNet::from_onnx(&std::fs::read(&p).unwrap()).unwrap())); }
    for (n, net) in &nets {
        net.run(&x).unwrap();
        let t = Instant::now();
        for _ in 0..10 { net.run(&x).unwrap(); }
        println!("{n}: {:.1} ms alone", t.elapsed().as_secs_f64() * 100.0);
        let t = Instant::now();
        std::thread::scope(|s| for _ in 0..2 { s.spawn(|| for _ in 0..10 { net.run(&x).unwrap(); }); });
        println!("{n}: {:.1} ms each, two at once", t.elapsed().as_secs_f64() * 100.0);
    }
}
