//! `cargo xtask bench isa`: what a driver makes of compute shaders, as a table: registers, spills, waves, instructions, and its
//! own estimates of time.
//!
//! Meant for Mesa's RADV, which compiles for chips that are not there (`RADV_FORCE_FAMILY`). Its estimates weigh loops by eight
//! for each level, whatever they really turn: for comparisons, not times. What does not live here: who makes the shaders
//! (`bench/gpu_vs_pnanovdb.sh`).

#![allow(unsafe_code, reason = "Vulkan is called as it is, on shaders of this repository")]
#![allow(clippy::print_stdout, reason = "the table is what the command is for")]

use std::collections::BTreeMap;
use std::error::Error;
use std::ffi::{CStr, CString};

use ash::vk;

/// The statistics that are printed, by the driver's names and ours.
const COLUMNS: [(&str, &str); 9] = [
    ("VGPRs", "VGPR"),
    ("SGPRs", "SGPR"),
    ("Spilled VGPRs", "spills"),
    ("Scratch size", "scratch"),
    ("Subgroups per SIMD", "waves"),
    ("Instructions", "instr"),
    ("Branches", "branches"),
    ("Latency", "latency"),
    ("Inverse Throughput", "inv.thr."),
];

/// A shader in the words that drivers take, and the name of its entry point.
struct Shader {
    words: Vec<u32>,
    entry_point: String,
}

/// Reads a shader: SPIR-V as it is, WGSL as wgpu would hand it to a driver whose buffers are robust.
fn read(path: &str) -> Result<Shader, Box<dyn Error>> {
    if path.ends_with(".spv") {
        let bytes = std::fs::read(path)?;
        let words = bytes.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)).collect();
        return Ok(Shader { words, entry_point: "main".to_owned() });
    }
    let text = std::fs::read_to_string(path)?;
    let module = naga::front::wgsl::parse_str(&text).map_err(|error| error.emit_to_string(&text))?;
    let entry_point = module.entry_points.first().ok_or("no entry point")?.name.clone();
    let flags = naga::valid::ValidationFlags::all();
    let info = naga::valid::Validator::new(flags, naga::valid::Capabilities::empty()).validate(&module)?;
    let options = naga::back::spv::Options {
        lang_version: (1, 4),
        flags: naga::back::spv::WriterFlags::empty(),
        force_loop_bounding: true,
        bounds_check_policies: naga::proc::BoundsCheckPolicies {
            index: naga::proc::BoundsCheckPolicy::Restrict,
            ..Default::default()
        },
        ..Default::default()
    };
    let pipeline = naga::back::spv::PipelineOptions {
        shader_stage: naga::ShaderStage::Compute,
        entry_point: entry_point.clone(),
    };
    let words = naga::back::spv::write_vec(&module, &info, &options, Some(&pipeline))?;
    Ok(Shader { words, entry_point })
}

/// The descriptors that SPIR-V binds: by set and binding, whether it is a uniform buffer; else it is a storage buffer.
fn bindings(words: &[u32]) -> BTreeMap<(u32, u32), bool> {
    const DECORATE: u32 = 71;
    const VARIABLE: u32 = 59;
    const BINDING: u32 = 33;
    const SET: u32 = 34;
    const UNIFORM: u32 = 2;
    let (mut places, mut uniforms) = (BTreeMap::new(), BTreeMap::new());
    let mut at = 5;
    while let Some(head) = words.get(at) {
        let length = (head >> 16) as usize;
        match (head & 0xffff, words.get(at + 1..at + length)) {
            (DECORATE, Some([id, BINDING, number])) => places.entry(*id).or_insert([0; 2])[1] = *number,
            (DECORATE, Some([id, SET, number])) => places.entry(*id).or_insert([0; 2])[0] = *number,
            (VARIABLE, Some([_, id, class, ..])) => {
                uniforms.insert(*id, *class == UNIFORM);
            }
            _ => {}
        }
        at += length.max(1);
    }
    let kind = |id: &u32| uniforms.get(id).copied().unwrap_or(false);
    places.iter().map(|(id, [set, binding])| ((*set, *binding), kind(id))).collect()
}

/// Prints the table of the first device that Vulkan has.
pub(crate) fn print(paths: &[String]) -> Result<(), Box<dyn Error>> {
    // SAFETY: handles are used on the device that made them, as Vulkan asks for, and live as long as the program.
    unsafe {
        let entry = ash::Entry::load()?;
        let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
        let create = vk::InstanceCreateInfo::default().application_info(&application);
        let instance = entry.create_instance(&create, None)?;
        let physical = *instance.enumerate_physical_devices()?.first().ok_or("no Vulkan device")?;
        let properties = instance.get_physical_device_properties(physical);
        let extensions = [vk::KHR_PIPELINE_EXECUTABLE_PROPERTIES_NAME.as_ptr()];
        let mut executables = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default()
            .pipeline_executable_info(true);
        let mut memory_model = vk::PhysicalDeviceVulkan12Features::default().vulkan_memory_model(true);
        let features = vk::PhysicalDeviceFeatures::default().robust_buffer_access(true);
        let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(0).queue_priorities(&[1.0])];
        let create = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(&extensions)
            .enabled_features(&features)
            .push_next(&mut executables)
            .push_next(&mut memory_model);
        let device = instance.create_device(physical, &create, None)?;
        let name = properties.device_name_as_c_str()?.to_string_lossy();
        print!("{name:<34}");
        COLUMNS.iter().for_each(|(_, column)| print!(" {column:>9}"));
        println!();
        for path in paths {
            let shader = read(path).map_err(|error| format!("{path}: {error}"))?;
            let found = statistics(&instance, &device, &shader)?;
            let file = std::path::Path::new(path).file_name().unwrap_or_default().to_string_lossy();
            print!("{file:<34}");
            for (statistic, _) in COLUMNS {
                print!(" {:>9}", found.get(statistic).map_or("-", String::as_str));
            }
            println!();
        }
    }
    Ok(())
}

/// What the driver says of a shader.
///
/// # Safety
/// The device is of the instance, with the features that [`print`] asks for.
unsafe fn statistics(
    instance: &ash::Instance,
    device: &ash::Device,
    shader: &Shader,
) -> Result<BTreeMap<String, String>, Box<dyn Error>> {
    let mut sets: BTreeMap<u32, Vec<vk::DescriptorSetLayoutBinding<'_>>> = BTreeMap::new();
    for ((set, binding), is_uniform) in bindings(&shader.words) {
        let kind = match is_uniform {
            true => vk::DescriptorType::UNIFORM_BUFFER,
            false => vk::DescriptorType::STORAGE_BUFFER,
        };
        let binding = vk::DescriptorSetLayoutBinding::default()
            .binding(binding)
            .descriptor_type(kind)
            .descriptor_count(1)
            .stage_flags(vk::ShaderStageFlags::COMPUTE);
        sets.entry(set).or_default().push(binding);
    }
    // SAFETY: as the caller promises; everything made here is of that device.
    unsafe {
        let mut layouts = Vec::new();
        for set in 0..=sets.keys().max().copied().unwrap_or(0) {
            let bindings = sets.remove(&set).unwrap_or_default();
            let create = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
            layouts.push(device.create_descriptor_set_layout(&create, None)?);
        }
        let create = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts);
        let layout = device.create_pipeline_layout(&create, None)?;
        let module = vk::ShaderModuleCreateInfo::default().code(&shader.words);
        let module = device.create_shader_module(&module, None)?;
        let name = CString::new(shader.entry_point.as_str())?;
        let stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module)
            .name(&name);
        let create = vk::ComputePipelineCreateInfo::default()
            .stage(stage)
            .layout(layout)
            .flags(vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR);
        let pipelines = device.create_compute_pipelines(vk::PipelineCache::null(), &[create], None);
        let pipeline = pipelines.map_err(|(_, error)| error)?[0];
        let executables = ash::khr::pipeline_executable_properties::Device::new(instance, device);
        let info = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline);
        let mut found = BTreeMap::new();
        for statistic in executables.get_pipeline_executable_statistics(&info)? {
            let value = match statistic.format {
                vk::PipelineExecutableStatisticFormatKHR::FLOAT64 => statistic.value.f64.to_string(),
                _ => statistic.value.u64.to_string(),
            };
            found.insert(CStr::from_ptr(statistic.name.as_ptr()).to_string_lossy().into_owned(), value);
        }
        Ok(found)
    }
}
