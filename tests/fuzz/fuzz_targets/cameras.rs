#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    plenoxel_fuzz::parsers::try_out("cameras.bin", bytes);
    plenoxel_fuzz::parsers::try_out("cameras.txt", bytes);
});
