use crate::{doctor::zipsplat, micro, noise};
use zipsplat::types::write_ply;
use zipsplat_tests::faults::{DEVICE_LOST, Faults, OUT_OF_DEVICE_MEMORY, OUT_OF_HOST_MEMORY, assert_survives};
use zipsplat_tests::prelude::*;

const RECONSTRUCT: &str = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/out.ply";
/// In flight while others are encoded and written.
const RENDER: &str = "render @/scene.ply --wiggle --frames 7 --size 40x30 -o @/out --video @/out.gif";

const WAITS: [&str; 3] = ["vkQueueSubmit2", "vkWaitSemaphores", "vkGetSemaphoreCounterValue"];

const ALLOCATIONS: [&str; 3] = ["vkCreateBuffer", "vkAllocateMemory", "vkMapMemory"];

const OTHERS: [&str; 13] = [
    "vkBindBufferMemory",
    "vkCreateSemaphore",
    "vkCreateCommandPool",
    "vkAllocateCommandBuffers",
    "vkBeginCommandBuffer",
    "vkEndCommandBuffer",
    "vkCreateShaderModule",
    "vkCreateDescriptorSetLayout",
    "vkCreateDescriptorPool",
    "vkAllocateDescriptorSets",
    "vkCreatePipelineLayout",
    "vkCreateComputePipelines",
    "vkQueueSubmit2",
];

#[test]
fn a_reconstruction_on_a_device_that_fails() {
    assert_survives("faults::commands::reconstructions_fail");
}

#[test]
#[ignore = "child of a_reconstruction_on_a_device_that_fails"]
fn reconstructions_fail() {
    let Some(folder) = target() else { return };
    let case = Case::new(&folder, RECONSTRUCT);
    case.fails_everywhere();
    // f16 needs a self-test first.
    let case = Case::new(&folder, &format!("{RECONSTRUCT} --precision fp16"));
    let forget = || drop(std::fs::remove_dir_all(std::env::var("ZIPSPLAT_CACHE").unwrap()));
    forget();
    for call in case.calls("vkQueueSubmit2").into_iter().take(2) {
        forget();
        case.fails("vkQueueSubmit2", call, DEVICE_LOST, 4, LOST);
    }
    // Too little memory for the self-test is not a kernel failure.
    forget();
    case.fails("vkAllocateMemory", 1, OUT_OF_DEVICE_MEMORY, 4, &["the driver refused"]);
    case.calls("vkAllocateMemory");
}

#[test]
fn pictures_on_a_device_that_fails() {
    assert_survives("faults::commands::pictures_fail");
}

#[test]
#[ignore = "child of pictures_on_a_device_that_fails"]
fn pictures_fail() {
    let Some(folder) = target() else { return };
    Case::new(&folder, RENDER).fails_everywhere();
}

const LOST: &[&str] = &["the Vulkan device was lost", "again"];

struct Case {
    folder: PathBuf,
    line: String,
    faults: Faults,
}

impl Case {
    fn new(folder: &Path, line: &str) -> Self {
        if !folder.join("photos").exists() {
            std::fs::create_dir(folder.join("photos")).unwrap();
            (0..2).for_each(|i| noise(40, 30, i).save_png(folder.join(format!("photos/{i}.png"))).unwrap());
            micro().save(folder.join("micro.safetensors"), Dtype::F32).unwrap();
            write_ply(&random_scene(300, 1, 0.1), folder.join("scene.ply")).unwrap();
        }
        let line = line.replace('@', &folder.display().to_string());
        Self { folder: folder.to_owned(), line, faults: Faults::inherited() }
    }

    fn fails_everywhere(&self) {
        for function in WAITS {
            self.calls(function).into_iter().for_each(|call| self.fails(function, call, DEVICE_LOST, 4, LOST));
        }
        for function in ALLOCATIONS {
            let words = &["bytes", "the driver refused"];
            self.calls(function)
                .into_iter()
                .for_each(|call| self.fails(function, call, OUT_OF_DEVICE_MEMORY, 4, words));
        }
        for function in OTHERS {
            let words = &[function, "host memory"];
            self.calls(function).into_iter().for_each(|call| self.fails(function, call, OUT_OF_HOST_MEMORY, 1, words));
        }
    }

    fn calls(&self, function: &str) -> Vec<u32> {
        self.faults.set(function, 0, 0);
        let (code, _, err) = zipsplat(&self.line);
        assert_eq!(code, 0, "{err}");
        self.clear();
        self.faults.calls(3)
    }

    fn fails(&self, function: &str, call: u32, result: i32, code: u8, words: &[&str]) {
        self.faults.set(function, call, result);
        let (found, out, err) = zipsplat(&self.line);
        let context = format!("{function}, call {call}, {result}: {err}");
        if found == 0 {
            // Submissions are split by time: a last call may be missing.
            assert!(self.faults.made() < call, "{context}: it was not told");
            return self.clear();
        }
        assert_eq!((found, out.as_str()), (code, ""), "{context}");
        let errors: Vec<&str> = err.lines().filter(|line| !line.starts_with("note: ")).collect();
        assert!(errors.len() == 1 && words.iter().all(|word| errors[0].contains(word)), "{context}");
        for path in self.written() {
            Image::open(&path).unwrap_or_else(|error| panic!("{context}: part of a picture: {error}"));
        }
        self.clear();
    }

    fn written(&self) -> Vec<PathBuf> {
        let entries = |folder: &Path| -> Vec<PathBuf> {
            folder.read_dir().into_iter().flatten().map(|entry| entry.unwrap().path()).collect()
        };
        let known = ["photos", "micro.safetensors", "scene.ply", "out"].map(|name| self.folder.join(name));
        let mut new: Vec<PathBuf> = entries(&self.folder).into_iter().filter(|path| !known.contains(path)).collect();
        new.extend(entries(&self.folder.join("out")));
        new
    }

    fn clear(&self) {
        self.written().into_iter().for_each(|path| std::fs::remove_file(path).unwrap());
    }
}
