use super::figures::Figures;
use super::*;
use plenoxel::run::folder::RunFolder;

fn measured(psnr: f64, seconds: f64, width: usize) -> Cell {
    let figures = Figures {
        psnr: Some(psnr),
        ssim: Some(0.5 + psnr / 100.0),
        seconds: Some(seconds),
        views: Some(3),
        width: Some(width),
        height: Some(width),
        background: [1.0; 3],
        ..Figures::default()
    };
    Cell::Measured(Box::new(Measured { folder: RunFolder::at("a, b".as_ref()), figures }))
}

/// A table of two scenes and two methods, of which one run fails, and published results for the first scene.
fn table() -> RunTable {
    let failed = Cell::Failed(Failure { code: 4, error: "loss is <NaN> | \"here\"".to_owned() });
    RunTable {
        title: "Two & two".to_owned(),
        methods: vec!["fast".to_owned(), "slow".to_owned()],
        rows: vec![
            Row { scene: "lego".to_owned(), cells: vec![measured(30.0, 34.25, 100), measured(25.0, 3.25, 50)] },
            Row { scene: "ship".to_owned(), cells: vec![measured(20.5, 100.0, 100), failed] },
        ],
        published: vec![Published {
            name: "Others".to_owned(),
            source: "their table".to_owned(),
            psnr: [("lego".to_owned(), 34.1)].into(),
            ssim: BTreeMap::new(),
            seconds: BTreeMap::new(),
        }],
        elsewhere: vec![Published {
            name: "Third".to_owned(),
            source: "a paper".to_owned(),
            psnr: [("mic".to_owned(), 20.0)].into(),
            ssim: BTreeMap::new(),
            seconds: [("chair".to_owned(), 2.0)].into(),
        }],
    }
}

#[test]
fn markdown_has_a_cell_for_each_run_and_means_of_whole_columns_only() {
    let text = markdown::text(&table());
    let expected = "\
# Two & two

| scene | fast | slow | Others (published) |
| --- | --- | --- | --- |
| lego | **30.00** · 0.800 · 34 s | **25.00** · 0.750 · 3.2 s | **34.10** · – · – |
| ship | **20.50** · 0.705 · 100 s | failed (4) | – |
| mean | **25.25** · 0.752 · 67 s | – | – |
| standard deviation | **4.75** · 0.048 · 33 s | – | – |

";
    let (table, notes) = text.split_at(expected.len());
    assert_eq!(table, expected);
    assert!(
        notes.contains(
            "- lego: fast, 3 views of 100 × 100 over white; slow, 3 views of 50 × 50 over white; these results are not comparable."
        ),
        "{notes}"
    );
    assert!(notes.contains("- ship: 3 views of 100 × 100 over white.\n"), "{notes}");
    assert!(notes.contains("- ship, slow: failed with exit code 4: loss is \\<NaN\\> \\| \"here\"\n"), "{notes}");
    assert!(notes.contains("- Others: published, not measured here: their table\n"), "{notes}");
    assert!(notes.contains("- Third: published for other scenes (chair, mic), not shown: a paper\n"), "{notes}");
}

#[test]
fn what_others_wrote_is_no_markup_in_the_table() {
    let mut table = table();
    table.rows[0].scene = "<script>alert(1)</script>".to_owned();
    table.rows[1].scene = "a_b *c* [d](e) _f_ &lt; x\x1b[2J\n| y".to_owned();
    table.methods[0] = "`m`".to_owned();
    let text = markdown::text(&table);
    assert!(text.contains("| \\<script\\>alert(1)\\</script\\> | **30.00**") && !text.contains("<script>"), "{text}");
    assert!(text.contains(r"| a_b \*c\* \[d\](e) \_f\_ \&lt; x\\u{1b}\[2J \| y | **20.50**"), "{text}");
    assert!(text.starts_with("# Two & two\n\n| scene | \\`m\\` | slow |"), "{text}");
    assert_eq!(text.lines().filter(|line| line.starts_with('|')).count(), 6, "{text}");
}

#[test]
fn one_scene_has_no_mean_and_no_deviation() {
    let mut table = table();
    table.rows.truncate(1);
    let text = markdown::text(&table) + &html::text(&table);
    assert!(!text.contains("| mean |") && !text.contains("<th>standard deviation</th>"), "{text}");
}

#[test]
fn csv_has_a_line_for_each_run_with_a_field_for_each_head() {
    let text = csv::text(&table());
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 1 + 4);
    let commas = lines[0].matches(',').count();
    assert_eq!(lines[1], "lego,fast,finished,30,0.8,,34.25,,,,,,white,3,100,100,,,\"a, b\"");
    // The comma in quotes separates no fields.
    assert_eq!(lines[1].matches(',').count(), commas + 1);
    assert_eq!(lines[4], "ship,slow,failed,,,,,,,,,,,,,,4,\"loss is <NaN> | \"\"here\"\"\",");
    assert_eq!(lines[4].matches(',').count(), commas);
}

#[test]
fn the_page_stands_by_itself_and_praises_only_what_can_be_compared() {
    let text = html::text(&table());
    assert!(text.contains("<title>Two &amp; two</title>") && text.contains("loss is &lt;NaN&gt; | &quot;here&quot;"), "{text}");
    assert!(text.contains(">30.00<") && text.contains("published, not measured here"), "{text}");
    assert!(text.contains("<th>standard deviation</th><td><div class=\"psnr\">4.75<"), "{text}");
    // Pictures are smaller in a table of many columns. This table has no pictures.
    let mut wide = table();
    wide.methods.extend(["other".to_owned(), "another".to_owned()]);
    assert!(
        text.contains("img { width: 300px;") && html::text(&wide).contains("img { width: 200px;") && !text.contains("Pictures:"),
        "{text}"
    );
    // The runs of lego were evaluated at different sizes.
    assert!(!text.contains("psnr best") && !text.contains("http") && !text.contains("src=\"images"), "{text}");
    let mut equal = table();
    equal.rows[0].cells[1] = measured(25.0, 3.25, 100);
    let text = html::text(&equal);
    assert!(text.contains("<div class=\"psnr best\">30.00<") && text.matches("psnr best").count() == 1, "{text}");
}
