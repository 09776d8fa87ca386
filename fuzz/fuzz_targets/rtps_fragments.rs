#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| adaptive_bridge_fuzz::rtps_fragments(bytes));
