//! What this program writes is on the disk before it has its name, and its name is there when the write is over: a loss of power leaves no empty
//! file, and takes back nothing that was said to be written. A library in front of the system's own notes which files are put on the disk.
#![cfg(target_os = "linux")]

use std::io::Write;
use std::path::Path;
use std::process::Command;

use sidecarm::image::{Image, Lasting, NewFile, VideoFile, write_atomically, write_lasting};
use sidecarm::record::{LogCopy, Provenance, Recorder};

const FOLDER: &str = "SIDECARM_TEST_LASTING";
const NOTES: &str = "SIDECARM_TEST_NOTES";

/// Notes the path of each file that `fsync` is asked for.
const LIBRARY: &str = r#"
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

int fsync(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    const char *notes = getenv("SIDECARM_TEST_NOTES");
    FILE *out = notes && length > 0 ? fopen(notes, "a") : NULL;
    if (out) {
        path[length] = 0;
        fprintf(out, "%s\n", path);
        fclose(out);
    }
    return (int)syscall(SYS_fsync, file);
}
"#;

/// Every way in which files are written.
fn write_all(folder: &Path) {
    write_lasting(&folder.join("strip.png"), Lasting::Later, |file| file.write_all(b"for eyes")).expect("written");
    write_atomically(&folder.join("pose.json"), |file| file.write_all(b"{}")).expect("written");
    let (new, mut file) = NewFile::create(&folder.join("carm.csv")).expect("begun");
    file.write_all(b"a,b").expect("written");
    new.appear().expect("there");
    let provenance = Provenance::of_this_program(1, serde_json::Value::Null);
    Recorder::create(&folder.join("session.mcap"), &provenance).expect("begun").finish().expect("finished");
    LogCopy::create(&folder.join("cut.mcap")).expect("begun").finish().expect("finished");
    let mut video = VideoFile::create(&folder.join("session.avi"), [16, 16], 2.0).expect("begun");
    video.add(&Image::filled(16, 16, [7u8; 3]), 1).expect("a picture");
    video.finish().expect("finished");
}

#[test]
fn a_file_is_on_the_disk_before_its_name_and_its_name_when_it_is_done() {
    if let Some(folder) = std::env::var_os(FOLDER) {
        return write_all(Path::new(&folder));
    }
    let scratch = tempfile::tempdir().expect("a folder");
    let real = std::fs::canonicalize(scratch.path()).expect("there");
    let (folder, notes, library) = (real.join("written"), real.join("notes"), real.join("notes.so"));
    std::fs::create_dir(&folder).expect("a folder");
    let source = real.join("notes.c");
    std::fs::write(&source, LIBRARY).expect("written");
    let made = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).arg(&source).status();
    if !made.is_ok_and(|status| status.success()) {
        println!("skipped: there is no compiler of C");
        return;
    }
    let name = "written_lasting::a_file_is_on_the_disk_before_its_name_and_its_name_when_it_is_done";
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    command.args(["--exact", name]).env(FOLDER, &folder).env(NOTES, &notes).env("LD_PRELOAD", &library);
    let ran = command.output().expect("runs");
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stdout));
    assert!(folder.join("strip.png").exists() && folder.join("cut.mcap").exists(), "the test found itself");
    let noted = std::fs::read_to_string(&notes).expect("something is put on the disk");
    let noted: Vec<String> = noted
        .lines()
        .map(|line| match Path::new(line).strip_prefix(&folder).map(|name| name.display().to_string()) {
            Ok(name) if name.is_empty() => "the folder".to_owned(),
            Ok(name) if name.starts_with(".sidecarm-") => "a file without its name".to_owned(),
            Ok(name) => name,
            Err(_) => line.to_owned(),
        })
        .collect();
    let whole = ["a file without its name", "the folder"];
    let expected = [&whole[..], &whole, &["session.mcap", "the folder"], &whole, &["session.avi"]].concat();
    assert_eq!(noted, expected, "strip.png, for eyes alone, is not among them");
}
