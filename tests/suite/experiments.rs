//! The paper's experiments at a size at which nothing can be concluded: that each method stands in the table and the picture shows something.

use unshaken::experiments::{Experiment, Lab};

/// The figure in the column `column` (0-based) of the row that begins with `name`.
#[track_caller]
fn figure(table: &str, name: &str, column: usize) -> f64 {
    let row = table.lines().find(|l| l.starts_with(&format!("| {name} |"))).unwrap_or_else(|| panic!("no row {name:?} in\n{table}"));
    row.split('|').nth(column + 1).and_then(|c| c.trim().parse().ok()).unwrap_or_else(|| panic!("no figure in {row}"))
}

#[test]
fn every_experiment_has_a_name_of_its_own() {
    let mut names: Vec<_> = Experiment::ALL.iter().map(|e| e.name()).collect();
    for (e, name) in Experiment::ALL.iter().zip(&names) {
        assert_eq!(Experiment::named(name).unwrap(), *e);
    }
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), Experiment::ALL.len());
    assert!(Experiment::named("fig2").err().unwrap().to_string().contains("fig10"));
}

#[test]
fn photographs_are_asked_for() {
    let said = Lab::new(96, 1, None).run(Experiment::Office, &mut |_| true).err().unwrap().to_string();
    assert!(said.contains("folder"), "{said}");
}

#[test]
fn figure_5_compares_all_methods() {
    let mut lab = Lab::new(96, 1, None);
    let report = lab.run(Experiment::Blurred, &mut |_| true).unwrap();
    let psnr = |name: &str| figure(&report.table, name, 1);
    let merged = psnr("all frames merged");
    assert!(psnr("unshaken") > merged + 1.0 && psnr("unshaken") > psnr("sharp frames, denoised") + 1.0, "{}", report.table);
    assert!(psnr("tripod merged") > psnr("sharp frames merged") + 1.0, "{}", report.table);
    // Across 96 pixels a uniform blur is all but the true one, with fewer numbers to find.
    for name in ["sharp frames merged", "sharp frames, denoised", "each deblurred, merged", "uniform blur only"] {
        assert!(psnr(name) > 5.0 && psnr(name) < psnr("unshaken") + 0.5, "{name}\n{}", report.table);
    }
    // What takes no noise off stays near the tripod's merge, which takes none off either.
    for name in ["sharp frames merged", "each deblurred, merged"] {
        assert!(psnr(name) < psnr("tripod merged") + 3.0, "{name}\n{}", report.table);
    }
    let bright = report.picture.pixels().filter(|p| p.0.iter().all(|v| *v > 60)).count();
    assert!(bright * 20 > report.picture.pixels().len(), "the picture is dark");
    assert!(lab.run(Experiment::Psfs, &mut |_| true).unwrap().table.lines().count() > 6, "local PSFs of both frames");
}

#[test]
fn figure_4_finds_the_psfs_of_the_longer_of_two_blurred_frames() {
    let mut lab = Lab::new(160, 1, None);
    assert!(lab.run(Experiment::BlindPsfs, &mut |_| false).is_err(), "cancelled");
    let table = lab.run(Experiment::BlindPsfs, &mut |_| true).unwrap().table;
    let figures = |line: &str| -> Vec<f64> { line.split('|').filter_map(|c| c.trim().parse().ok()).collect() };
    let rows: Vec<Vec<f64>> = table.lines().filter(|l| l.contains("| 1 s |")).map(figures).collect();
    assert!(rows.len() >= 3, "{table}");
    for row in rows {
        let [_, _, _, error, point] = row[..] else { panic!("{table}") };
        assert!(error < 0.5 * point, "smoothed by a pixel {error} off, no blur at all {point}\n{table}");
    }
}
