//! A sound for each exposure, for whoever has no eye for the screen: one high tone for an accepted pose, two for one to beware of, telemetry's
//! included, a low one where there is none. A player of the system makes it audible; where there is none, or it fails, that is said once.

use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use super::SessionError;
use crate::image::temporary_folder;
use crate::report::Standing;
use crate::reporter::Reporter;
use crate::time::Stopwatch;

/// Programs that play a WAV file named as their last argument, the first that is there: PipeWire, PulseAudio, ALSA, macOS.
const PLAYERS: [&[&str]; 4] = [&["pw-play"], &["paplay"], &["aplay", "-q"], &["afplay"]];
/// A player that takes longer is stopped.
const PATIENCE: Duration = Duration::from_secs(3);
const RATE_HZ: u32 = 22_050;
/// Loudness, of 1.
const LEVEL: f64 = 0.4;
/// Tones begin and end softly, s.
const RAMP_S: f64 = 0.01;

/// Frequency in Hz (0 for a rest) and length in s, one after the other.
type Tones = &'static [(f64, f64)];

fn tones(standing: Standing) -> (&'static str, Tones) {
    match standing {
        Standing::Accepted => ("accepted", &[(880.0, 0.15)]),
        // There is a DRR beside the frame, at a pose that no bead has confirmed.
        Standing::ImageDisagrees | Standing::TelemetryDisagrees | Standing::InDoubt | Standing::Telemetry => {
            ("beware", &[(660.0, 0.12), (0.0, 0.08), (660.0, 0.12)])
        }
        Standing::Refused | Standing::NoPose => ("refused", &[(220.0, 0.45)]),
    }
}

/// 16-bit mono PCM as a WAV file.
fn wav(tones: Tones) -> Vec<u8> {
    let rate = f64::from(RATE_HZ);
    let tone = |(hz, length_s): &(f64, f64)| {
        let (hz, length_s) = (*hz, *length_s);
        (0..(length_s * rate) as usize).map(move |n| {
            let at_s = n as f64 / rate;
            let ramp = (at_s.min(length_s - at_s) / RAMP_S).clamp(0.0, 1.0);
            ((std::f64::consts::TAU * hz * at_s).sin() * ramp * LEVEL * f64::from(i16::MAX)) as i16
        })
    };
    let samples: Vec<u8> = tones.iter().flat_map(tone).flat_map(i16::to_le_bytes).collect();
    let bytes = samples.len() as u32;
    // RIFF, format (PCM, one channel, two bytes a sample), data.
    let mut file = Vec::with_capacity(44 + samples.len());
    file.extend(b"RIFF");
    file.extend((36 + bytes).to_le_bytes());
    file.extend(b"WAVEfmt ");
    file.extend(16u32.to_le_bytes());
    file.extend([1u16, 1].map(u16::to_le_bytes).concat());
    file.extend([RATE_HZ, 2 * RATE_HZ].map(u32::to_le_bytes).concat());
    file.extend([2u16, 16].map(u16::to_le_bytes).concat());
    file.extend(b"data");
    file.extend(bytes.to_le_bytes());
    file.extend(samples);
    file
}

/// Plays on a thread of its own, one sound at a time; exposures that come meanwhile are silent.
#[derive(Clone, Debug)]
pub(super) struct Chime {
    sounds: SyncSender<Standing>,
}

impl Chime {
    /// Starts the thread.
    pub(super) fn start(reporter: &Reporter) -> Result<Self, SessionError> {
        Self::with_players(PLAYERS.map(|words| words.iter().map(PathBuf::from).collect()).into(), reporter)
    }

    fn with_players(players: Vec<Vec<PathBuf>>, reporter: &Reporter) -> Result<Self, SessionError> {
        let (sounds, asked) = sync_channel(1);
        let reporter = reporter.clone();
        std::thread::Builder::new()
            .name("chime".to_owned())
            .spawn(move || {
                if let Err(words) = play_all(&asked, &players) {
                    reporter.warn("no sound", format!("exposures make no sound: {words}"));
                }
            })
            .map_err(|source| SessionError::Thread { source })?;
        Ok(Self { sounds })
    }

    /// An exposure has come to this.
    pub(super) fn sound(&self, standing: Standing) {
        // Busy, or given up.
        let _ = self.sounds.try_send(standing);
    }
}

fn play_all(asked: &Receiver<Standing>, players: &[Vec<PathBuf>]) -> Result<(), String> {
    let folder = temporary_folder(&std::env::temp_dir()).map_err(|error| format!("no temporary folder ({error})"))?;
    for standing in asked {
        let (name, tones) = tones(standing);
        let path = folder.path().join(format!("{name}.wav"));
        if !path.exists() {
            let mut file = std::fs::File::create(&path).map_err(|error| error.to_string())?;
            file.write_all(&wav(tones)).map_err(|error| error.to_string())?;
        }
        play(&path, players)?;
    }
    Ok(())
}

fn play(path: &std::path::Path, players: &[Vec<PathBuf>]) -> Result<(), String> {
    for player in players {
        let Some((program, words)) = player.split_first() else { continue };
        let mut command = Command::new(program);
        command.args(words).arg(path).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = match command.spawn() {
            Ok(child) => child,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
            Err(error) => return Err(format!("{} does not start ({error})", program.display())),
        };
        let since = Stopwatch::start();
        while since.ms() < PATIENCE.as_secs_f64() * 1e3 {
            match child.try_wait() {
                Ok(Some(status)) if status.success() => return Ok(()),
                Ok(Some(_)) => return Err(format!("{} plays nothing; is there a loudspeaker?", program.display())),
                Ok(None) => std::thread::sleep(Duration::from_millis(10)),
                Err(error) => return Err(error.to_string()),
            }
        }
        let _ = child.kill();
        let _ = child.wait();
        return Err(format!("{} does not end", program.display()));
    }
    Err("no player is installed (pw-play, paplay or aplay)".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pose from telemetry is amber on the screen and sounded like a refusal.
    #[test]
    fn a_pose_from_telemetry_sounds_like_one_to_beware_of() {
        let heard = |standing: Standing| wav(tones(standing).1);
        assert_eq!(heard(Standing::Telemetry), heard(Standing::InDoubt));
        for other in [Standing::Refused, Standing::NoPose, Standing::Accepted] {
            assert_ne!(heard(Standing::Telemetry), heard(other), "{other:?}");
        }
    }

    #[test]
    fn each_verdict_has_a_sound_of_its_own() {
        let mut heard = Vec::new();
        for standing in [Standing::Accepted, Standing::InDoubt, Standing::Refused] {
            let file = wav(tones(standing).1);
            assert_eq!((&file[..4], &file[8..16], file.len()), (&b"RIFF"[..], &b"WAVEfmt "[..], 44 + (file.len() - 44) / 2 * 2));
            assert_eq!(u32::from_le_bytes([file[40], file[41], file[42], file[43]]) as usize, file.len() - 44);
            let samples: Vec<i16> = file[44..].chunks_exact(2).map(|pair| i16::from_le_bytes([pair[0], pair[1]])).collect();
            let crossings = samples.windows(2).filter(|pair| (pair[0] < 0) != (pair[1] < 0)).count();
            heard.push(crossings);
            assert!(samples.iter().all(|sample| sample.unsigned_abs() < 14_000), "it does not clip");
        }
        // Two crossings a period.
        assert!(heard[0].abs_diff(264) < 6 && heard[1].abs_diff(317) < 8 && heard[2].abs_diff(198) < 6, "{heard:?}");
    }

    #[cfg(unix)]
    #[test]
    fn the_first_player_that_is_there_plays_and_one_that_fails_is_said_once() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().expect("a folder");
        let script = |name: &str, body: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).expect("written");
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("a program");
            path
        };
        let list = folder.path().join("played");
        let good = script("good", &format!("echo \"$1 $(basename \"$2\")\" >> '{}'", list.display()));
        let missing = folder.path().join("missing");
        let players = vec![vec![missing.clone()], vec![good, PathBuf::from("-q")]];
        let path = folder.path().join("x.wav");
        play(&path, &players).expect("played");
        assert_eq!(std::fs::read_to_string(&list).expect("it played"), "-q x.wav\n");
        assert!(play(&path, &[vec![missing]]).expect_err("none").contains("no player"));
        assert!(play(&path, &[vec![script("bad", "exit 1")]]).expect_err("fails").contains("plays nothing"));

        let reporter = Reporter::silent();
        let chime = Chime::with_players(vec![vec![folder.path().join("bad")]], &reporter).expect("a thread");
        for _ in 0..100 {
            chime.sound(Standing::Accepted);
            if !reporter.warnings().is_empty() {
                break;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        chime.sound(Standing::Accepted);
        assert_eq!(reporter.warnings().get("no sound").map(|counted| counted.count), Some(1));
    }
}
