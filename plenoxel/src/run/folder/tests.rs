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
    // What is not a run is not overwritten, come what may.
    let refused = NewFolder::choose(Some(&path), "x", true).unwrap_err();
    assert!(refused.exit_code() == 2 && refused.to_string().contains("not a run"), "{refused}");
    std::fs::write(path.join(RECORD), "{}").unwrap();
    NewFolder::choose(Some(&path), "x", true).unwrap().create().unwrap();
    let there = |name: &&&str| path.join(name).exists();
    assert_eq!((mine.iter().filter(there).count(), ours.iter().filter(there).count()), (mine.len(), 0));
    std::fs::remove_dir_all(path).unwrap();
}
