//! Videos of camera paths: a looping GIF and, if `ffmpeg` is installed, an MP4.

use crate::progress::Console;
use gif::{Encoder, Frame, Repeat};
use plenoxel::dataset::image;
use plenoxel::error::Result;
use plenoxel::export::palette::quantize;
use plenoxel::files::atomically;
use plenoxel::run::machine;
use rayon::prelude::*;
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Shortest delay of a GIF frame, in hundredths of a second; viewers replace shorter delays by a default.
const SHORTEST: u64 = 2;

/// The PNG frames of a camera path.
pub struct Reel<'a> {
    /// Folder of `frame_0000<suffix>.png` and so on.
    pub folder: &'a Path,
    pub suffix: &'a str,
    /// Number of frames, at least 1.
    pub frames: usize,
    /// Frames per second.
    pub fps: f64,
}

impl Reel<'_> {
    /// Writes `<folder><suffix>.gif` and `.mp4`, and prints their paths.
    pub fn write(&self, console: &Console<'_>) -> Result<()> {
        let gif = self.file("gif");
        self.write_gif(&gif, console)?;
        console.result(&format!("wrote {}", gif.display()))?;
        let mp4 = self.file("mp4");
        match has_ffmpeg() {
            true => {
                self.write_mp4(&mp4)?;
                console.result(&format!("wrote {}", mp4.display()))
            }
            false => {
                console.note(&format!("{} was not written: ffmpeg is not in PATH", mp4.display()));
                Ok(())
            }
        }
    }

    fn file(&self, ending: &str) -> PathBuf {
        let mut path = self.folder.as_os_str().to_owned();
        path.push(format!("{}.{ending}", self.suffix));
        path.into()
    }

    /// Writes the GIF. Each frame has its own palette, computed as for .vox files: the palettes of the `gif` crate (NeuQuant) lose small bright
    /// details, such as the red lamps of lego. Each thread processes one frame at a time.
    fn write_gif(&self, path: &Path, console: &Console<'_>) -> Result<()> {
        let (width, height) = image::size(&self.frame(0))?;
        let count = console.count("encoding the GIF, frame", self.frames);
        let numbers: Vec<usize> = (0..self.frames).collect();
        atomically(path, |temporary| {
            let file = BufWriter::new(File::create(temporary)?);
            // Images have no more than 16384 pixels a side.
            let mut encoder = Encoder::new(file, width as u16, height as u16, &[]).map_err(io::Error::other)?;
            encoder.set_repeat(Repeat::Infinite).map_err(io::Error::other)?;
            for numbers in numbers.chunks(machine::threads()) {
                let frames: io::Result<Vec<Frame<'_>>> = numbers.par_iter().map(|&number| self.gif_frame(number)).collect();
                for frame in frames? {
                    encoder.write_lzw_pre_encoded_frame(&frame).map_err(io::Error::other)?;
                }
                count.at(numbers[0] + numbers.len(), self.frames);
            }
            Ok(())
        })
    }

    fn gif_frame(&self, number: usize) -> io::Result<Frame<'static>> {
        let picture = image::read(&self.frame(number)).map_err(io::Error::other)?;
        let colors: Vec<[u8; 3]> = picture.pixels().map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2]]).collect();
        let (palette, entries) = quantize(&colors, 256);
        let (width, height) = (picture.width() as u16, picture.height() as u16);
        let mut frame = Frame::from_palette_pixels(width, height, entries, palette.into_flattened(), None);
        frame.delay = delay(number, self.fps);
        frame.make_lzw_pre_encoded();
        Ok(frame)
    }

    /// Writes the MP4 with ffmpeg's default codec (usually H.264), BT.709 colors and 4:2:0 chroma subsampling, which every player supports. Width and
    /// height are rounded up to even numbers.
    fn write_mp4(&self, path: &Path) -> Result<()> {
        let even = "scale=ceil(iw/2)*2:ceil(ih/2)*2:out_color_matrix=bt709,format=yuv420p";
        let (fps, frames, input) = (self.fps.to_string(), self.frames.to_string(), format!("frame_%04d{}.png", self.suffix));
        atomically(path, |temporary| {
            let output = std::path::absolute(temporary)?;
            let mut ffmpeg = Command::new("ffmpeg");
            // In the folder of the frames, because its name could contain pattern characters.
            ffmpeg.current_dir(self.folder).stdin(Stdio::null());
            ffmpeg.args(["-nostdin", "-loglevel", "error", "-y", "-framerate", &fps, "-start_number", "0", "-i", &input]);
            ffmpeg.args(["-frames:v", &frames, "-vf", even, "-crf", "18", "-colorspace", "bt709", "-color_primaries", "bt709"]);
            ffmpeg.args(["-color_trc", "bt709", "-movflags", "+faststart", "-f", "mp4"]).arg(&output);
            let answer = ffmpeg.output()?;
            if answer.status.success() {
                return Ok(());
            }
            let told = String::from_utf8_lossy(&answer.stderr);
            let last = told.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no reason given");
            Err(io::Error::other(format!("ffmpeg failed ({}): {last}", answer.status)))
        })
    }

    fn frame(&self, number: usize) -> PathBuf {
        self.folder.join(format!("frame_{number:04}{}.png", self.suffix))
    }
}

/// True if ffmpeg is installed. Other errors are reported when it is used.
fn has_ffmpeg() -> bool {
    let answer = Command::new("ffmpeg").arg("-version").stdin(Stdio::null()).output();
    !answer.is_err_and(|error| error.kind() == ErrorKind::NotFound)
}

/// Delay of a frame in hundredths of a second, rounded so that the total duration matches the rate.
fn delay(number: usize, fps: f64) -> u16 {
    let until = |frames: usize| (100.0 * frames as f64 / fps).round() as u64;
    (until(number + 1) - until(number)).clamp(SHORTEST, u64::from(u16::MAX)) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_add_up_to_the_length_of_the_film() {
        assert_eq!((0..6).map(|n| delay(n, 30.0)).collect::<Vec<_>>(), [3, 4, 3, 3, 4, 3]);
        assert_eq!((0..30).map(|n| u64::from(delay(n, 24.0))).sum::<u64>(), 125);
        assert_eq!((delay(0, 100.0), delay(7, 0.1), delay(0, 0.001)), (2, 1000, u16::MAX));
    }
}
