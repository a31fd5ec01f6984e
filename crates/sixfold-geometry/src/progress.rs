//! Progress of long functions in all crates: they report how far they are and can be asked to stop.

/// Receives the progress of a function. It is implemented for closures `|done, total| -> bool`, and for `()`, which ignores all
/// reports.
///
/// Parallel functions report from any of their threads, each part once it is done, so numbers may arrive out of order. The
/// result of a function does not depend on the receiver unless the receiver stops it.
pub trait Progress: Sync {
    /// `done` of `total` parts are done. Returning `false` stops the function after its current part; its documentation states
    /// what it then returns.
    fn report(&self, done: usize, total: usize) -> bool;
}

impl Progress for () {
    fn report(&self, _: usize, _: usize) -> bool {
        true
    }
}

impl<F: Fn(usize, usize) -> bool + Sync> Progress for F {
    fn report(&self, done: usize, total: usize) -> bool {
        self(done, total)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn count(parts: usize, progress: &dyn Progress) -> Option<usize> {
        (1..=parts).try_fold(0, |sum, part| progress.report(part, parts).then_some(sum + part))
    }

    #[test]
    fn a_closure_receives_every_part_and_can_stop_it() {
        let reported = AtomicUsize::new(0);
        let until = |last: usize| {
            reported.store(0, Ordering::Relaxed);
            let sum = count(4, &|done, total| {
                assert_eq!((reported.fetch_add(1, Ordering::Relaxed) + 1, 4), (done, total));
                done < last
            });
            (sum, reported.load(Ordering::Relaxed))
        };
        assert_eq!(until(9), (Some(10), 4));
        assert_eq!(until(2), (None, 2));
        assert_eq!(count(4, &()), Some(10));
    }
}
