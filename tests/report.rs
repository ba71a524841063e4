//! `report.html`: that the page is whole, needs nothing from elsewhere, and holds the grid.

use crate::command::{Folder, plenoxel, train};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::read::ZlibDecoder;
use serde_json::Value;
use std::fs;
use std::io::Read;

/// What is between two texts of a page.
fn between<'a>(page: &'a str, before: &str, after: &str) -> &'a str {
    let from = page.find(before).unwrap_or_else(|| panic!("no {before}")) + before.len();
    &page[from..from + page[from..].find(after).unwrap()]
}

/// Checks that nothing in a page makes a browser ask for something.
fn check_alone(page: &str) {
    // The name of the SVG namespace is no address, and an empty icon keeps browsers from asking for one.
    let rest = page.replace("http://www.w3.org/2000/svg", "").replace("<link rel=\"icon\" href=\"data:,\">", "");
    for word in ["http:", "https:", "//cdn", "@import", "<link", "fetch(", "XMLHttpRequest", "url("] {
        assert!(!rest.contains(word), "{word} in the page");
    }
    let sources = rest.match_indices(" src=\"").map(|(at, found)| &rest[at + found.len()..at + found.len() + 5]);
    assert!(sources.into_iter().all(|source| source == "data:"));
}

fn settings_of(page: &str) -> Value {
    serde_json::from_str(between(page, "<script type=\"application/json\" id=\"scene\">", "</script>")).unwrap()
}

#[test]
fn a_run_ends_with_a_page_that_holds_its_figures_its_pictures_and_its_grid() {
    let folder = Folder::new("report");
    let run = folder.path("a <run>");
    let trained = train("6,1,3", &run, &[]);
    let result = trained.json();
    assert!(trained.err.contains("report.html") && trained.err.contains("dB"), "{}", trained.err);
    let page = fs::read_to_string(folder.path("a <run>/report.html")).unwrap();
    check_alone(&page);
    assert!(page.contains("<h1>a &lt;run&gt; – procedural</h1>"));
    assert!(page.contains(&format!("{:.2} dB", result["psnr"].as_f64().unwrap())));
    for view in result["per_view"].as_array().unwrap() {
        let caption = format!(
            "{}: {:.2} dB, SSIM {:.4}",
            view["name"].as_str().unwrap(),
            view["psnr"].as_f64().unwrap(),
            view["ssim"].as_f64().unwrap()
        );
        assert!(page.contains(&caption), "{caption}");
    }
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 4, "the stages, and three test views");
    assert_eq!(page.matches("<svg").count(), 4 + 4 + 2, "curves over steps and over seconds, and plans of the cameras");
    assert_eq!(page.matches("<span>target</span><span>render</span><span>error</span><span>depth</span>").count(), 3);
    assert!(page.contains("<span>start</span><span>8³</span><span>12³</span><span>photograph</span>"), "the stages have names");
    assert!(page.contains("stages[0]") || page.contains("[[stages]]"), "the settings");

    let settings = settings_of(&page);
    assert_eq!((&settings["grid"]["resolution"], settings["views"].as_array().unwrap().len()), (&12.into(), 3));
    let packed = STANDARD.decode(between(&page, "id=\"grid\">", "</script>")).unwrap();
    let mut bytes = Vec::new();
    ZlibDecoder::new(packed.as_slice()).read_to_end(&mut bytes).unwrap();
    // Of each voxel two bytes of density, and one for each number of its color.
    let grid = &settings["grid"];
    let numbers = 3 + grid["harmonics"]["steps"].as_array().map_or(0, Vec::len) as u64;
    assert!(bytes.len() as u64 > grid["voxels"].as_u64().unwrap() * (2 + numbers) && grid["voxels"].as_u64().unwrap() > 100);

    // It can be made again, and left out.
    fs::remove_file(folder.path("a <run>/report.html")).unwrap();
    assert!(plenoxel(&["report", &run]).done().contains("report.html"));
    assert_eq!(fs::read_to_string(folder.path("a <run>/report.html")).unwrap(), page);
    train("6,1,3", &run, &["--force", "--no-report"]).done();
    assert!(!fs::exists(folder.path("a <run>/report.html")).unwrap());
}

#[test]
fn a_carved_run_has_a_page_too() {
    let folder = Folder::new("report-carved");
    let run = folder.path("run");
    plenoxel(&["carve", "--resolution", "16", "--downscale", "8", "--out", &run]).done();
    let page = fs::read_to_string(folder.path("run/report.html")).unwrap();
    check_alone(&page);
    assert!(page.contains("carving the hull") && page.contains("<h2>Carved grid</h2>") && !page.contains("<h2>Curves</h2>"));
    assert_eq!(settings_of(&page)["grid"]["interpolation"], "nearest");
}

#[test]
fn an_evaluated_carved_run_has_figures_in_the_comparison_and_the_report() {
    let folder = Folder::new("report-evaluated");
    let [carved, trained, page] = ["carved", "trained", "page.html"].map(|name| folder.path(name));
    let data = folder.path("data");
    plenoxel(&["scene", &data, "--size", "24", "--train", "6", "--val", "1", "--test", "2"]).done();
    plenoxel(&["carve", &data, "--resolution", "16", "--out", &carved]).done();
    train("6,1,2", &trained, &["--no-report"]).done();
    let row = |run: &str| {
        let said = plenoxel(&["compare", &trained, &carved, "--out", &page]).done();
        let line = said.lines().find(|line| line.contains(&format!("| {run} "))).unwrap_or_else(|| panic!("{said}")).to_owned();
        line.split('|').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(row(&carved)[4..6], ["–", "–"]);
    // Figures of other images are not those of the run.
    plenoxel(&["evaluate", &carved, "--downscale", "2"]).json();
    plenoxel(&["evaluate", &carved, "--split", "train"]).json();
    assert_eq!(row(&carved)[4..6], ["–", "–"]);

    let evaluated = plenoxel(&["evaluate", &carved]);
    assert!(evaluated.err.contains("plenoxel compare"), "{}", evaluated.err);
    let figures = evaluated.json();
    let (psnr, ssim) = (figures["psnr"].as_f64().unwrap(), figures["ssim"].as_f64().unwrap());
    assert_eq!(row(&carved)[4..6], [format!("{psnr:.2}"), format!("{ssim:.4}")]);
    assert_ne!(row(&carved)[6], "–", "the time is that of carving");
    plenoxel(&["report", &carved]).done();
    let page = fs::read_to_string(folder.path("carved/report.html")).unwrap();
    assert!(page.contains(&format!("<b>{psnr:.2} dB</b>")) && page.contains("scores of all 2 test views"));

    // A trained run has its figures, and keeps them.
    plenoxel(&["evaluate", &trained]).json();
    assert!(!fs::exists(folder.path("trained/evaluation.json")).unwrap());
    // A run that is carved again is another one.
    plenoxel(&["carve", &data, "--resolution", "16", "--out", &carved, "--force"]).done();
    assert_eq!(row(&carved)[4..6], ["–", "–"]);
}

#[test]
fn runs_are_compared_by_figures_settings_curves_and_pictures() {
    let folder = Folder::new("compare");
    let [first, second, page] = ["first", "second", "page.html"].map(|name| folder.path(name));
    for (run, seed) in [(&first, "1"), (&second, "2")] {
        train("6,1,2", run, &["--no-report", "--seed", seed]).done();
    }
    let said = plenoxel(&["compare", &first, &second, "--out", &page]).done();
    let lines: Vec<&str> = said.lines().collect();
    assert!(lines[0].starts_with("| run ") && lines[2].contains(&first) && lines[3].contains(&second), "{said}");
    assert!(lines[..4].iter().all(|line| line.chars().count() == lines[0].chars().count()), "{said}");
    let page = fs::read_to_string(page).unwrap();
    check_alone(&page);
    // The seed is all that differs.
    assert!(page.contains("1 setting differs") && page.contains("<td>seed</td><td>1</td><td>2</td>"));
    // Of two views the photograph, and the picture and the error of each run; loss, both kinds of PSNR and voxels over two axes.
    assert_eq!((page.matches("data:image/jpeg;base64,").count(), page.matches("<svg").count()), (10, 8));
    plenoxel(&["compare", &folder.path("none")]).refused(3, &["this run folder does not exist"]);
    fs::write(folder.path("second/result.json"), "figures").unwrap();
    plenoxel(&["compare", &first, &second]).refused(3, &["second", "result.json of this run is missing or damaged", "--resume"]);
    let metrics = folder.path("second/metrics.jsonl");
    fs::write(&metrics, fs::read_to_string(&metrics).unwrap() + "{\"step\":").unwrap();
    let report = plenoxel(&["report", &second]);
    assert!(report.err.contains(&format!("warning: {metrics}: 1 unreadable line left out of the curves")), "{}", report.err);
    report.done();
    assert!(fs::read_to_string(folder.path("second/report.html")).unwrap().contains("no valid results"));
}
