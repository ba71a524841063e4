#![no_main]

// The words of a command line, by lines.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Ok(text) = std::str::from_utf8(bytes) {
        plenoxel_fuzz::parsers::try_arguments(&std::iter::once("plenoxel").chain(text.lines()).collect::<Vec<_>>());
    }
});
