#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| sidecarm_fuzz::adapter(data));
