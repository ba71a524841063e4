#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    plenoxel_fuzz::parsers::try_out("tree.npz", bytes);
});
