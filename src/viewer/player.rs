//! Plays exposures one after the other, at their pace or faster.

/// How fast.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// So many times as fast as it was.
    Times(f64),
    /// One after the other, as fast as an eye may follow.
    Max,
}

/// Speeds to choose from.
pub(super) const SPEEDS: [Speed; 6] =
    [Speed::Times(1.0), Speed::Times(2.0), Speed::Times(5.0), Speed::Times(10.0), Speed::Times(100.0), Speed::Max];

/// Between two exposures at [`Speed::Max`].
const FASTEST_S: f64 = 0.05;

impl Speed {
    /// As a button shows it.
    #[must_use]
    pub fn word(self) -> String {
        match self {
            Self::Times(times) => format!("{times:.0}×"),
            Self::Max => "max".to_owned(),
        }
    }
}

/// See the module.
#[derive(Clone, Copy, Debug, Default)]
pub struct Player {
    /// Index in the speeds to choose from.
    speed: usize,
    playing: Option<Playing>,
}

#[derive(Clone, Copy, Debug)]
struct Playing {
    /// Of the window's clock.
    looked_s: f64,
    stepped_s: f64,
    /// Of the recorded clock.
    head_us: f64,
}

impl Player {
    /// How fast it plays.
    #[must_use]
    pub fn speed(&self) -> Speed {
        SPEEDS[self.speed]
    }

    /// Whether it plays.
    #[must_use]
    pub fn is_playing(&self) -> bool {
        self.playing.is_some()
    }

    /// The next faster speed, or slower.
    pub(super) fn shift_speed(&mut self, by: isize) {
        self.speed = self.speed.saturating_add_signed(by).min(SPEEDS.len() - 1);
    }

    /// Begins at `now_s` with an exposure of `time_us`.
    pub(super) fn start(&mut self, now_s: f64, time_us: i64) {
        self.playing = Some(Playing { looked_s: now_s, stepped_s: now_s, head_us: time_us as f64 });
    }

    /// Stands still.
    pub(super) fn stop(&mut self) {
        self.playing = None;
    }

    /// Which of the exposures at `times_us` is shown at `now_s`, when `at` was shown until now; stops at the last one.
    pub(super) fn advance(&mut self, now_s: f64, times_us: &[i64], at: usize) -> usize {
        let speed = self.speed();
        let Some(playing) = &mut self.playing else { return at };
        let since_s = (now_s - playing.looked_s).max(0.0);
        playing.looked_s = now_s;
        let mut at = at;
        match speed {
            Speed::Times(times) => {
                playing.head_us += since_s * 1e6 * times;
                while times_us.get(at + 1).is_some_and(|next_us| *next_us as f64 <= playing.head_us) {
                    at += 1;
                }
            }
            Speed::Max if now_s - playing.stepped_s >= FASTEST_S && at + 1 < times_us.len() => {
                at += 1;
                playing.stepped_s = now_s;
                playing.head_us = times_us[at] as f64;
            }
            Speed::Max => {}
        }
        if at + 1 >= times_us.len() {
            self.stop();
        }
        at
    }

    /// How long nothing changes.
    pub(super) fn rests_s(&self, times_us: &[i64], at: usize) -> Option<f64> {
        let playing = self.playing?;
        let next_us = *times_us.get(at + 1)? as f64;
        Some(match self.speed() {
            Speed::Times(times) => ((next_us - playing.head_us) * 1e-6 / times).max(0.01),
            Speed::Max => FASTEST_S,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_plays_at_the_recorded_pace_faster_and_stops_at_the_end() {
        let times_us = [0, 1_000_000, 1_500_000, 9_000_000];
        let mut player = Player::default();
        player.start(100.0, times_us[0]);
        assert_eq!(player.advance(100.9, &times_us, 0), 0);
        assert_eq!(player.advance(101.1, &times_us, 0), 1);
        assert_eq!(player.advance(101.6, &times_us, 1), 2);
        player.shift_speed(1);
        assert_eq!((player.speed(), player.advance(104.0, &times_us, 2)), (Speed::Times(2.0), 2));
        assert!(player.is_playing());
        assert_eq!(player.advance(106.0, &times_us, 2), 3);
        assert!(!player.is_playing());
        player.shift_speed(100);
        player.start(0.0, times_us[0]);
        let mut at = 0;
        let shown: Vec<usize> = (0..9)
            .map(|step| {
                at = player.advance(f64::from(step) * 0.03, &times_us, at);
                at
            })
            .collect();
        assert_eq!((player.speed(), shown), (Speed::Max, vec![0, 0, 1, 1, 2, 2, 3, 3, 3]));
    }
}
