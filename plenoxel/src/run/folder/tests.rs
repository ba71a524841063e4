use super::*;

#[test]
fn the_first_free_number_is_taken_and_names_become_plain() {
    let root = std::env::temp_dir().join(format!("plenoxel-runs-{}", std::process::id()));
    std::fs::create_dir_all(root.join("my-lego-1")).unwrap();
    std::fs::create_dir_all(root.join("my-lego-3")).unwrap();
    for (scene, path) in [("my lego", "my-lego-2"), ("my lego", "my-lego-4"), ("../x", "..-x-1")] {
        assert_eq!(reserve(&root, scene).unwrap(), root.join(path));
        assert!(root.join(path).is_dir());
    }
    std::fs::remove_dir_all(root).unwrap();
}

#[test]
fn an_occupied_folder_is_refused_unless_forced_and_other_files_survive() {
    let path = std::env::temp_dir().join(format!("plenoxel-occupied-{}", std::process::id()));
    for folder in ["images/paper", "exports/blender", "renders/orbit", "renders-best/orbit"] {
        std::fs::create_dir_all(path.join(folder)).unwrap();
    }
    let mine = ["notes.txt", "exports/notes.txt", "exports/blender/final.glb", "images/paper/figure_1.png", "renders/orbit/title.png"];
    let ours = [
        CHECKPOINT,
        "events.out.tfevents.17.plenoxel",
        "images/old.png",
        "exports/mesh.glb",
        "renders/orbit.mp4",
        "renders/orbit/frame_0001.png",
        "renders-best/orbit/frame_0001.exr",
    ];
    mine.iter().chain(&ours).for_each(|name| std::fs::write(path.join(name), "x").unwrap());
    let refused = NewFolder::choose(Some(&path), "x", false).unwrap_err();
    assert!(refused.exit_code() == 2 && refused.to_string().contains("--force"));
    // A folder that is not a run is never overwritten.
    let refused = NewFolder::choose(Some(&path), "x", true).unwrap_err();
    assert!(refused.exit_code() == 2 && refused.to_string().contains("not a run"), "{refused}");
    std::fs::write(path.join(RECORD), "{}").unwrap();
    // Files that cannot be removed are found before any file is removed.
    std::fs::create_dir(path.join(RESULT)).unwrap();
    let refused = NewFolder::choose(Some(&path), "x", true).unwrap_err();
    assert!(refused.to_string().contains("its result.json is a folder") && path.join(CHECKPOINT).exists(), "{refused}");
    std::fs::remove_dir(path.join(RESULT)).unwrap();
    let folder = RunFolder::at(&path);
    assert!(folder.owns(&path.join(CHECKPOINT)) && folder.owns(&path.join("images/old.png")));
    assert!(!folder.owns(&path.join("notes.txt")) && !folder.owns(Path::new("nowhere/checkpoint.safetensors")));
    let new = NewFolder::choose(Some(&path), "x", true).unwrap();
    assert_eq!(new.overwritten(), 1);
    drop(new);
    NewFolder::choose(Some(&path), "x", true).unwrap().create().unwrap();
    let there = |name: &&&str| path.join(name).exists();
    assert_eq!((mine.iter().filter(there).count(), ours.iter().filter(there).count()), (mine.len(), 0));
    std::fs::remove_dir_all(path).unwrap();
}

#[test]
fn a_run_that_ended_before_its_first_step_is_overwritten_without_being_forced() {
    let path = std::env::temp_dir().join(format!("plenoxel-nothing-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    for name in [RECORD, CONFIG] {
        std::fs::write(path.join(name), "{}").unwrap();
    }
    std::fs::write(path.join(METRICS), "").unwrap();
    NewFolder::choose(Some(&path), "x", false).unwrap().create().unwrap();
    for name in [RECORD, METRICS] {
        std::fs::write(path.join(name), "{}").unwrap();
    }
    assert!(NewFolder::choose(Some(&path), "x", false).unwrap_err().to_string().contains("--force"));
    std::fs::remove_dir_all(path).unwrap();
}

#[test]
fn a_folder_that_was_replaced_is_not_written() {
    let root = std::env::temp_dir().join(format!("plenoxel-replaced-{}", std::process::id()));
    let (path, moved) = (root.join("run"), root.join("moved"));
    let folder = NewFolder::choose(Some(&path), "x", false).unwrap().create().unwrap();
    folder.write_result(&1).unwrap();
    std::fs::rename(&path, &moved).unwrap();
    std::fs::create_dir(&path).unwrap();
    let refused = folder.write_result(&2).unwrap_err();
    assert!(refused.to_string().contains("moved, deleted or replaced"), "{refused}");
    assert_eq!(std::fs::read_dir(&path).unwrap().count(), 0);
    std::fs::remove_dir_all(root).unwrap();
}
