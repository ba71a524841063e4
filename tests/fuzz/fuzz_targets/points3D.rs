#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    plenoxel_fuzz::parsers::try_out("points3D.bin", bytes);
    plenoxel_fuzz::parsers::try_out("points3D.txt", bytes);
});
