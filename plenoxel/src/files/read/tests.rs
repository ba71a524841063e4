use super::*;
use std::path::PathBuf;

const SMALL: Kind = Kind { name: "a small file", most: 100, memory: 1 };

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("plenoxel-read-{}-{name}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, bytes).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn refused<T: std::fmt::Debug>(result: Result<T>, code: u8, part: &str) {
    let error = result.unwrap_err();
    assert!(error.exit_code() == code && error.to_string().contains(part), "{code} and {part} in {error}");
}

#[test]
fn a_file_is_read_up_to_the_size_of_its_kind() {
    let folder = Folder::new("size");
    let path = folder.write("a", &[7; 100]);
    assert_eq!((read(&path, SMALL).unwrap(), read_named(&path, SMALL).unwrap()), (vec![7; 100], vec![7; 100]));
    let path = folder.write("b", &[7; 101]);
    refused(open(&path, SMALL), 3, "too large: a small file may have at most 0 kB; expected a small file");
    refused(read(&path, SMALL), 3, "too large");
    refused(read_named(&path, SMALL), 3, "too large");
    let greedy = Kind { memory: u64::MAX / 101, most: 101, ..SMALL };
    refused(read(&path, greedy), 3, "of memory, but");
}

#[test]
fn what_is_no_file_is_said_to_be_what_it_is() {
    let folder = Folder::new("kinds");
    for read in [read, read_named] {
        refused(read(&folder.0, SMALL), 3, "this is a folder; expected a small file");
        refused(read(&folder.0.join("none"), SMALL), 3, "this file does not exist");
    }
    assert!(is_there(&folder.0) && !is_there(&folder.0.join("none")));
}

#[cfg(unix)]
mod unix {
    use super::*;
    use std::io::Write;
    use std::os::unix::fs::{PermissionsExt, symlink};

    /// A pipe with a name.
    fn pipe(folder: &Folder) -> PathBuf {
        let path = folder.0.join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        path
    }

    #[test]
    fn what_may_never_end_is_not_opened_unless_the_user_named_it() {
        let folder = Folder::new("endless");
        let (pipe, link) = (pipe(&folder), folder.0.join("link"));
        refused(open(&pipe, SMALL), 3, "this is a pipe, not a plain file");
        symlink("/dev/zero", &link).unwrap();
        refused(read(&link, SMALL), 3, "this is a device, not a plain file");
        refused(read_named(&link, SMALL), 3, "too large");
        if memory::available().is_some() {
            refused(read_named(&link, Kind { most: 1 << 60, memory: 1 << 20, ..SMALL }), 3, "of memory, but");
        }
        let socket = folder.0.join("socket");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        refused(read(&socket, SMALL), 3, "this is a socket");

        for (length, fits) in [(100, true), (101, false)] {
            let writer = std::thread::spawn({
                let pipe = pipe.clone();
                move || drop(fs::File::options().write(true).open(pipe).unwrap().write_all(&vec![7; length]))
            });
            assert_eq!(read_named(&pipe, SMALL).is_ok(), fits, "{length}");
            writer.join().unwrap();
        }
    }

    #[test]
    fn links_are_followed_and_say_so_where_they_lead_nowhere() {
        let folder = Folder::new("links");
        let (file, link) = (folder.write("a", b"x"), folder.0.join("link"));
        symlink(&file, &link).unwrap();
        assert_eq!(read(&link, SMALL).unwrap(), b"x");
        fs::remove_file(file).unwrap();
        assert!(is_there(&link));
        refused(read(&link, SMALL), 3, "this symbolic link is broken");
    }

    #[test]
    fn what_one_may_not_read_is_there() {
        let folder = Folder::new("closed");
        let inner = folder.0.join("inner");
        fs::create_dir(&inner).unwrap();
        let path = folder.write("inner/a", b"x");
        fs::set_permissions(&inner, fs::Permissions::from_mode(0o000)).unwrap();
        // Root may read everything.
        let result = read(&path, SMALL);
        fs::set_permissions(&inner, fs::Permissions::from_mode(0o700)).unwrap();
        if result.is_err() {
            refused(result, 5, "change its permissions");
        }
    }
}

#[test]
fn text_is_utf_8_or_utf_16_with_a_mark() {
    let path = Path::new("t.json");
    let text = |bytes: &[u8]| text(path, bytes).map(Cow::into_owned);
    assert_eq!(text("ä{}".as_bytes()).unwrap(), "ä{}");
    assert_eq!(text("\u{feff}ä{}".as_bytes()).unwrap(), "ä{}");
    let utf16 = |unit: fn(u16) -> [u8; 2]| "\u{feff}ä{}𝄞".encode_utf16().flat_map(unit).collect::<Vec<u8>>();
    for bytes in [utf16(u16::to_le_bytes), utf16(u16::to_be_bytes)] {
        assert_eq!(text(&bytes).unwrap(), "ä{}𝄞");
        refused(text(&bytes[..bytes.len() - 1]), 3, "t.json: this file has a byte order mark of UTF-16");
        refused(text(&bytes[..bytes.len() - 2]), 3, "t.json: this file has a byte order mark of UTF-16");
    }
    refused(text(b"{\n\xff}"), 3, "t.json: line 2 is not valid UTF-8");
}
