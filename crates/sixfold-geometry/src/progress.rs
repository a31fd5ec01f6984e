//! The one way in which a long function of any crate says how far it is, and hears whether to go on.

/// Receives how far a function is. Closures `|done, total| -> bool` are one, and `()` is one that nobody looks at.
///
/// Functions that work in parallel report from any of their threads, each part once it is done; the numbers may then arrive in
/// another order. What such a function returns does not depend on who listens, as long as nobody stops it.
pub trait Progress: Sync {
    /// `done` of `total` parts are done. `false` stops the function at its next whole part; its documentation says what it then
    /// returns.
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
    fn a_closure_is_told_of_every_part_and_may_stop_it() {
        let told = AtomicUsize::new(0);
        let until = |last: usize| {
            told.store(0, Ordering::Relaxed);
            let sum = count(4, &|done, total| {
                assert_eq!((told.fetch_add(1, Ordering::Relaxed) + 1, 4), (done, total));
                done < last
            });
            (sum, told.load(Ordering::Relaxed))
        };
        assert_eq!(until(9), (Some(10), 4));
        assert_eq!(until(2), (None, 2));
        assert_eq!(count(4, &()), Some(10));
    }
}
