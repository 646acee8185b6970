#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| segwild_fuzzing::feed("sog_splats", bytes));
