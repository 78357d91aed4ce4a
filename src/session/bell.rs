//! Tells whoever shows a state that it has changed, and not more often than an eye can follow.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::time::Stopwatch;

/// Between two looks at the state.
pub const LEAST_BETWEEN: Duration = Duration::from_millis(50);

/// Called with how long to wait before looking.
type Waker = Box<dyn Fn(Duration) + Send>;

/// See the module.
#[derive(Default)]
pub(super) struct Bell(Mutex<Ringing>);

#[derive(Default)]
struct Ringing {
    waker: Option<Waker>,
    /// It has rung, and nobody has looked since.
    rung: bool,
    looked: Option<Stopwatch>,
    generation: u64,
}

impl Bell {
    /// Who is told from now on.
    pub(super) fn tell(&self, waker: Waker) {
        self.lock().waker = Some(waker);
    }

    /// Something changed: rings once until somebody looks, so late that looks are [`LEAST_BETWEEN`] apart.
    pub(super) fn ring(&self) {
        let mut ringing = self.lock();
        ringing.generation += 1;
        if std::mem::replace(&mut ringing.rung, true) {
            return;
        }
        let since = ringing.looked.map_or(LEAST_BETWEEN, |looked| Duration::from_secs_f64(looked.ms() * 1e-3));
        if let Some(waker) = &ringing.waker {
            waker(LEAST_BETWEEN.saturating_sub(since));
        }
    }

    /// Somebody looks.
    pub(super) fn looked(&self) {
        let mut ringing = self.lock();
        ringing.rung = false;
        ringing.looked = Some(Stopwatch::start());
    }

    /// Counts the changes.
    pub(super) fn generation(&self) -> u64 {
        self.lock().generation
    }

    fn lock(&self) -> MutexGuard<'_, Ringing> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn many_changes_ring_once_until_somebody_looks_and_not_at_once_after_that() {
        let bell = Bell::default();
        let heard: Arc<Mutex<Vec<Duration>>> = Arc::default();
        let hears = Arc::clone(&heard);
        bell.tell(Box::new(move |after| hears.lock().expect("unbroken").push(after)));
        (0..1000).for_each(|_| bell.ring());
        assert_eq!((*heard.lock().expect("unbroken")).clone(), [Duration::ZERO]);
        bell.looked();
        (0..1000).for_each(|_| bell.ring());
        let heard = heard.lock().expect("unbroken").clone();
        assert_eq!((heard.len(), bell.generation()), (2, 2000));
        assert!(heard[1] > Duration::ZERO && heard[1] <= LEAST_BETWEEN, "{heard:?}");
    }
}
