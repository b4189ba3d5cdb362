//! Every shader, parsed and validated by naga without a GPU, and its structures against the program's mirrors of them.

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Module, Statement, TypeInner};
use std::collections::BTreeSet;
use unshaken::kernels::{NOISE_STEPS, SHADERS, params_sizes, table_sizes};

/// Shaders that draw for the window; what they sample are textures.
const DRAWING: [&str; 3] = ["picture", "shrink", "display"];

fn parse(name: &str, source: &str) -> Module {
    naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)))
}

fn module(name: &str) -> Module {
    let (_, source) = SHADERS.iter().find(|s| s.0 == name).unwrap_or_else(|| panic!("no shader is called {name}"));
    parse(name, source)
}

/// Bytes of a structure as naga lays it out, and its members.
fn structure<'a>(module: &'a Module, name: &str) -> (usize, &'a [naga::StructMember]) {
    let found = module.types.iter().find_map(|(_, t)| match &t.inner {
        TypeInner::Struct { members, span } if t.name.as_deref() == Some(name) => Some((*span as usize, members.as_slice())),
        _ => None,
    });
    found.unwrap_or_else(|| panic!("no structure is called {name}"))
}

#[test]
fn every_shader_is_valid_without_extensions() {
    for (name, source) in SHADERS {
        let module = parse(name, source);
        let result = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module);
        result.unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
        let entries: Vec<_> = module.entry_points.iter().map(|e| e.name.as_str()).collect();
        if DRAWING.contains(name) {
            assert_eq!(entries, ["corners", "main"], "{name}: draws");
            continue;
        }
        assert_eq!(entries, ["main"], "{name}");
        let lanes: u32 = module.entry_points[0].workgroup_size.iter().product();
        let expected = if name.starts_with("blur_tile") { 32 * 8 } else { 16 * 8 };
        assert_eq!(lanes, expected, "{name}: dispatches count on workgroups of so many");
    }
}

#[test]
fn every_shader_file_is_in_the_list() {
    let listed: BTreeSet<String> = SHADERS.iter().map(|s| format!("{}.wgsl", s.0)).collect();
    assert_eq!(listed.len(), SHADERS.len(), "a name stands twice");
    let files = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/shaders")).expect("the folder of shaders");
    let files: BTreeSet<String> =
        files.map(|f| f.expect("readable").file_name().into_string().expect("ASCII")).filter(|n| n.ends_with(".wgsl")).collect();
    assert_eq!(listed, files);
}

#[test]
fn bindings_are_one_uniform_and_at_most_eight_storage_buffers() {
    for (name, source) in SHADERS {
        let module = parse(name, source);
        let mut bound: Vec<_> =
            module.global_variables.iter().filter_map(|(_, v)| v.binding.map(|b| (b.group, b.binding, v.space))).collect();
        bound.sort_by_key(|b| (b.0, b.1));
        for (i, &(group, binding, space)) in bound.iter().enumerate() {
            assert_eq!((group, binding as usize), (0, i), "{name}: bindings are 0, 1, 2, ... of group 0");
            // The tables of the blur are uniform, too: their loads are cheap there.
            let table = ["tap_sum", "tap_adjoint", "warp", "warp_direct", "warp_adjoint", "warp_adjoint_near"].contains(name);
            let tables = if name.starts_with("blur_tile") { 2 } else { usize::from(table) };
            assert_eq!(space == AddressSpace::Uniform, i <= tables, "{name}: binding {i}");
        }
        assert!(bound.len() <= 9, "{name}: {} storage buffers", bound.len() - 1);
    }
}

#[test]
fn mirrors_are_as_large_as_the_shaders_structures() {
    let sizes = params_sizes();
    let named: BTreeSet<&str> = sizes.iter().map(|s| s.0).collect();
    assert_eq!(named, SHADERS.iter().map(|s| s.0).collect(), "every shader has its parameters");
    for (name, bytes) in sizes {
        assert_eq!(structure(&module(name), "Params").0, bytes, "{name}: Params");
    }
    for (name, table, bytes) in table_sizes() {
        assert_eq!(structure(&module(name), table).0, bytes, "{name}: {table}");
    }
}

#[test]
fn noise_curves_have_the_length_that_shaders_expect() {
    for name in ["weights", "misfit"] {
        let module = module(name);
        let (size, members) = structure(&module, "Params");
        let noise = members.iter().find(|m| m.name.as_deref() == Some("noise")).expect("Params holds the noise");
        assert_eq!(size - noise.offset as usize, NOISE_STEPS * 4, "{name}");
    }
}

/// Whether a block holds a barrier, at any depth.
fn has_barrier(block: &naga::Block) -> bool {
    block.iter().any(|s| matches!(s, Statement::ControlBarrier(_)) || blocks(s).into_iter().any(has_barrier))
}

/// Whether a block returns elsewhere than at the function's end (`tail`), where naga itself puts returns.
fn returns(block: &naga::Block, tail: bool) -> bool {
    let last = block.len().saturating_sub(1);
    block.iter().enumerate().any(|(i, s)| {
        let tail = tail && i == last && !matches!(s, Statement::Loop { .. });
        matches!(s, Statement::Return { .. }) && !tail || blocks(s).into_iter().any(|b| returns(b, tail))
    })
}

fn blocks(statement: &Statement) -> Vec<&naga::Block> {
    match statement {
        Statement::Block(b) => vec![b],
        Statement::If { accept, reject, .. } => vec![accept, reject],
        Statement::Switch { cases, .. } => cases.iter().map(|c| &c.body).collect(),
        Statement::Loop { body, continuing, .. } => vec![body, continuing],
        _ => Vec::new(),
    }
}

/// naga accepts a return before a barrier, at which the lanes that are left then wait for ever, or not at all.
fn returns_before_barrier(module: &Module) -> bool {
    let body = &module.entry_points[0].function.body;
    has_barrier(body) && returns(body, true)
}

#[test]
fn no_lane_returns_before_a_barrier() {
    for (name, source) in SHADERS {
        assert!(!returns_before_barrier(&parse(name, source)), "{name}");
    }
    // The check itself: it sees what naga lets pass.
    let early = "@compute @workgroup_size(128) fn main(@builtin(local_invocation_index) i: u32) {
        if i > 3u { return; }
        for (var s = 64u; s > 0u; s >>= 1u) { workgroupBarrier(); }
    }";
    let module = parse("early return", early);
    assert!(Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module).is_ok());
    assert!(returns_before_barrier(&module));
    assert!(!returns_before_barrier(&parse("none", &early.replace("return;", ""))));
}

#[test]
fn solvers_sample_nothing_and_nobody_holds_infinity() {
    for (name, source) in SHADERS {
        let code: String = source.lines().map(|l| l.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n");
        // Samplers interpolate with eight fractional bits on real GPUs.
        for word in ["textureSample", "sampler", "1.0 / 0.0", "atomic"] {
            assert!(!code.contains(word) || word == "textureSample" && DRAWING.contains(name), "{name}: {word}");
        }
    }
}
