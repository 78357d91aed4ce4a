//! What the workshop is to do, and in which order.

use std::cmp::Reverse;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::busy::Busy;
use super::posed::Posed;
use crate::render::Plan;

/// A frame, and the plan to execute where a log has one.
pub(super) struct Job {
    pub(super) posed: Posed,
    pub(super) plan: Option<Plan>,
}

/// What is made before what.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Order {
    /// Of a session: the newest frame, which somebody looks at; nulls when no frame waits or comes; of a frame that is edited step by step the
    /// last step. What the first frame would wait for is done before it comes.
    #[default]
    NewestFirst,
    /// Of a replay: each frame as it is handed in, and its null behind it. What the planner has fitted for one frame serves the next, and no null
    /// is left out: two replays make the same of a log, whatever each of them had to wait for.
    AsHandedIn,
}

#[derive(Default)]
pub(super) struct Queue {
    pub(super) order: Order,
    pub(super) jobs: Vec<Job>,
    /// Frames are on their way here.
    pub(super) awaits: bool,
    /// A frame is being developed.
    pub(super) busy: bool,
    /// No more frames will come.
    pub(super) closed: bool,
    /// What is left is not wanted any more.
    pub(super) abandoned: bool,
    /// The thread has ended.
    pub(super) ended: bool,
}

impl Queue {
    /// Whether nulls are left for later: somebody looks at the frame that waits or comes, and nobody at the null, which takes the cores on which
    /// that is registered.
    pub(super) fn puts_nulls_off(&self) -> bool {
        let comes = self.awaits && !self.closed;
        self.abandoned || (self.order == Order::NewestFirst && (comes || !self.jobs.is_empty()))
    }

    /// Where the frame is that is developed next.
    fn first(&self) -> Option<usize> {
        let order = |job: &Job| (job.posed.number, Reverse(job.posed.development));
        match self.order {
            Order::NewestFirst => (0..self.jobs.len()).max_by_key(|index| order(&self.jobs[*index])),
            Order::AsHandedIn => (!self.jobs.is_empty()).then_some(0),
        }
    }
}

#[derive(Default)]
pub(super) struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
    pub(super) busy: Busy,
}

impl Shared {
    pub(super) fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn change(&self, change: impl FnOnce(&mut Queue)) {
        change(&mut self.lock());
        self.changed.notify_all();
    }
}

pub(super) enum Next {
    Frame(Box<Job>),
    Null,
    End,
}

/// Waits for something to do; `has_nulls`: some pair waits for its null.
pub(super) fn next(shared: &Shared, has_nulls: bool) -> Next {
    let mut queue = shared.lock();
    loop {
        queue.busy = false;
        if queue.abandoned {
            return Next::End;
        }
        if has_nulls && !queue.puts_nulls_off() {
            return Next::Null;
        }
        if let Some(first) = queue.first() {
            queue.busy = true;
            return Next::Frame(Box::new(queue.jobs.remove(first)));
        }
        if queue.closed {
            return Next::End;
        }
        queue = shared.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn queue(order: Order, change: &dyn Fn(&mut Queue)) -> Queue {
        let mut queue = Queue { order, ..Queue::default() };
        change(&mut queue);
        queue
    }

    fn waits(queue: &mut Queue, numbers: &[u32]) {
        queue.jobs.extend(numbers.iter().map(|number| Job { posed: Posed::bare(*number), plan: None }));
    }

    #[test]
    fn a_null_is_put_off_for_a_frame_that_waits_or_comes_and_for_nothing_else() {
        let puts_off = |order, change: &dyn Fn(&mut Queue)| queue(order, change).puts_nulls_off();
        let live = |change: &dyn Fn(&mut Queue)| puts_off(Order::NewestFirst, change);
        assert!(live(&|queue| waits(queue, &[1])), "a frame waits");
        assert!(live(&|queue| queue.awaits = true), "a frame is being registered");
        assert!(live(&|queue| queue.abandoned = true), "nothing is wanted any more");
        // A session that was told to end makes what it has.
        assert!(!live(&|queue| queue.closed = true), "no frame waits");
        assert!(!live(&|queue| (queue.closed, queue.awaits) = (true, true)), "no frame comes any more");
        assert!(!live(&|_| ()), "no frame waits");
        let replay = |change: &dyn Fn(&mut Queue)| puts_off(Order::AsHandedIn, change);
        assert!(!replay(&|queue| waits(queue, &[1])) && !replay(&|queue| queue.awaits = true), "two replays make the same");
        assert!(replay(&|queue| queue.abandoned = true), "nothing is wanted any more");
    }

    /// What comes next of frames 2, 3 and 1, until there is nothing to do; after each frame its null waits.
    fn made(order: Order) -> Vec<String> {
        let shared = Shared::default();
        shared.change(|of_shared| {
            *of_shared = queue(order, &|queue| waits(queue, &[2, 3, 1]));
            of_shared.closed = true;
        });
        let (mut made, mut nulls) = (Vec::new(), Vec::new());
        loop {
            match next(&shared, !nulls.is_empty()) {
                Next::Frame(job) => {
                    made.push(job.posed.number.to_string());
                    nulls.push(job.posed.number);
                }
                Next::Null => made.extend(nulls.pop().map(|number| format!("null of {number}"))),
                Next::End => return made,
            }
        }
    }

    /// Replays made the newest frame of those that happened to wait, and left out nulls where more than twelve did: which, hung on the machine.
    #[test]
    fn a_session_makes_the_newest_frame_first_and_a_replay_each_in_its_turn() {
        assert_eq!(made(Order::NewestFirst), ["3", "2", "1", "null of 1", "null of 2", "null of 3"]);
        assert_eq!(made(Order::AsHandedIn), ["2", "null of 2", "3", "null of 3", "1", "null of 1"]);
    }
}
