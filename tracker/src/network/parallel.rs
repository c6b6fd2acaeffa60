//! Parallel runs of a network in several views.

use rayon::prelude::*;

/// Returns `work` of every index below `count`, in order.
///
/// With two or more cores per run, all run at once on threads of their own, and their networks' products share the cores
/// ([`LandmarkNet::run`](crate::network::landmark_net::LandmarkNet::run)). Otherwise as many as there are cores run in
/// parallel on rayon's threads, where a network uses a single core; the few that are left over run in sequence on this
/// thread, each on all cores.
pub(crate) fn map_parallel<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    let threads = rayon::current_num_threads().max(1);
    if count > 1 && threads >= 2 * count && rayon::current_thread_index().is_none() {
        return on_own_threads(count, &work);
    }
    let left = count % threads;
    let alone = if 2 * left <= threads { count - left } else { count };
    let mut results: Vec<T> = (0..alone).into_par_iter().map(&work).collect();
    results.extend((alone..count).map(work));
    results
}

/// Returns `work` of every index below `count`, each on a thread of its own.
fn on_own_threads<T: Send>(count: usize, work: &(impl Fn(usize) -> T + Sync)) -> Vec<T> {
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..count).map(|at| scope.spawn(move || work(at))).collect();
        let join = |thread: std::thread::ScopedJoinHandle<'_, T>| match thread.join() {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        threads.into_iter().map(join).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_is_done_once_in_order_from_any_thread() {
        let square = |at: usize| at * at;
        for count in [0, 1, 2, 7, 100] {
            let expected: Vec<usize> = (0..count).map(square).collect();
            assert_eq!(map_parallel(count, square), expected);
            let (inside, _) = rayon::join(|| map_parallel(count, square), || ());
            assert_eq!(inside, expected);
            assert_eq!(on_own_threads(count, &square), expected);
        }
    }
}
