#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    plenoxel_fuzz::parsers::try_out("images.bin", bytes);
    plenoxel_fuzz::parsers::try_out("images.txt", bytes);
});
