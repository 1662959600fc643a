use zipsplat::reconstruct::{Network, Shape, TokenSampling};
use zipsplat::{gpu::ArenaRow, kernels::ops::Add, stages::ViewGrid};
use zipsplat_tests::prelude::*;

fn add(rec: &mut Recorder, left: Tensor, right: Tensor, len: usize) -> Tensor {
    let out = rec.tensor::<f32>("out", len);
    rec.dispatch(Add { left, right, out, count: len as u32 }, len);
    rec.output(out);
    out
}

#[test]
fn inputs_are_written_before_every_run_and_constants_once() {
    let mut rec = Recorder::new(device().limits());
    let (input, constant) = (rec.input::<f32>("picture", 5), rec.constant::<f32>("table", 5));
    let out = add(&mut rec, input, constant, 5);
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    let refused = |run: &mut Run, name: &str| {
        let error = run.execute().unwrap_err();
        assert!(matches!(&error, Error::Argument { what, .. } if what.contains(name)), "{error}");
    };
    refused(&mut run, "picture");
    run.write(input, &[1.0f32; 5]).unwrap();
    refused(&mut run, "table");
    run.write(constant, &[0.0f32, 1.0, 2.0, 3.0, 4.0]).unwrap();
    run.execute().unwrap();
    assert_same("first run", &run.read::<f32>(out).unwrap(), &[1.0, 2.0, 3.0, 4.0, 5.0]);
    refused(&mut run, "picture");
    run.write(input, &[10.0f32; 5]).unwrap();
    run.execute().unwrap();
    assert_same("second run", &run.read::<f32>(out).unwrap(), &[10.0, 11.0, 12.0, 13.0, 14.0]);
}

#[test]
fn a_cancelled_run_has_used_up_its_inputs() {
    let mut rec = Recorder::new(device().limits());
    let input = rec.input::<f32>("picture", 5);
    let out = add(&mut rec, input, input, 5);
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    run.write(input, &[1.0f32; 5]).unwrap();
    assert!(matches!(run.execute_with(|_| ControlFlow::Break(())), Err(Error::Cancelled)));
    assert!(run.execute().is_err(), "later tensors may have overwritten the input");
    run.write(input, &[2.0f32; 5]).unwrap();
    run.execute().unwrap();
    assert_same("after cancelling", &run.read::<f32>(out).unwrap(), &[4.0f32; 5]);
}

#[test]
fn nothing_to_do_is_done() {
    let mut rec = Recorder::new(device().limits());
    let (left, right) = (rec.input::<f32>("left", 0), rec.input::<f32>("right", 0));
    let out = add(&mut rec, left, right, 0);
    let copy = rec.tensor::<f32>("copy", 0);
    rec.fill(copy, 7);
    rec.copy(out, copy);
    rec.output(copy);
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    run.execute().unwrap();
    assert!(run.read::<f32>(out).unwrap().is_empty() && run.read::<f32>(copy).unwrap().is_empty());

    let mut nothing = Run::new(device(), Recorder::new(device().limits()).finish().unwrap()).unwrap();
    assert!(nothing.plan().is_empty() && nothing.plan().arena_bytes() == 0);
    nothing.execute().unwrap();
}

#[test]
fn fills_and_copies_touch_nothing_else() {
    let mut rec = Recorder::new(device().limits());
    let source = rec.input::<u32>("source", 70);
    let (filled, copied) = (rec.tensor::<u32>("filled", 70), rec.tensor::<u32>("copied", 70));
    for whole in [filled, copied] {
        rec.fill(whole, 1);
        rec.output(whole);
    }
    rec.fill(filled.slice::<u32>(64, 1), 5);
    rec.copy(source.slice::<u32>(64, 1), copied.slice::<u32>(0, 1));
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    run.write(source, &[9u32; 70]).unwrap();
    run.execute().unwrap();
    let expected = |at: usize, value: u32| (0..70).map(|i| if i == at { value } else { 1 }).collect::<Vec<u32>>();
    assert_same("fill", &run.read::<u32>(filled).unwrap(), &expected(64, 5));
    assert_same("copy", &run.read::<u32>(copied).unwrap(), &expected(0, 9));
}

#[test]
fn under_validation_scratch_is_nan_until_it_is_written() {
    let device = Device::open(&DeviceOptions { validation: true, ..Default::default() }).unwrap();
    let mut rec = Recorder::new(device.limits());
    let (left, right) = (rec.input::<f32>("left", 5), rec.input::<f32>("right", 5));
    add(&mut rec, left, right, 5);
    let (unwritten, copy) = (rec.tensor::<u32>("unwritten", 5), rec.tensor::<u32>("copy", 5));
    rec.copy(unwritten, copy);
    rec.output(copy);
    let mut run = Run::new(&device, rec.finish().unwrap()).unwrap();
    for value in [1.0f32, 2.0] {
        run.write(left, &[value; 5]).unwrap();
        run.write(right, &[value; 5]).unwrap();
        run.execute().unwrap();
        assert_same("NaN", &run.read::<u32>(copy).unwrap(), &[u32::MAX; 5]);
    }
}

#[test]
#[ignore = "needs tools/dev/test-bounds.sh"]
fn reading_beyond_what_is_bound_is_noticed() {
    let mut rec = Recorder::new(device().limits());
    let (left, right) = (rec.input::<f32>("left", 128), rec.input::<f32>("right", 128));
    add(&mut rec, left, right.slice::<f32>(0, 64), 128);
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    run.write(left, &[1.0f32; 128]).unwrap();
    run.write(right, &[1.0f32; 128]).unwrap();
    assert_refused(run.execute(), &["access out of bounds"]);
}

#[test]
fn a_binding_beyond_the_limit_is_named() {
    let mut rec = Recorder::new(&Limits { max_binding_bytes: 4096, ..Limits::default() });
    let (left, right) = (rec.input::<f32>("left", 1024), rec.input::<f32>("right", 1025));
    add(&mut rec, left, right, 1024);
    let error = rec.finish().unwrap_err();
    let Error::Memory { what, needed, available } = &error else { panic!("{error}") };
    assert!(what.contains("ops/add") && what.contains("right"), "{what}");
    assert_eq!((*needed, *available), (4100, 4096));
}

#[test]
fn a_tensor_beyond_a_block_is_named() {
    let mut rec = Recorder::new(&Limits { max_block_bytes: 1 << 20, ..Limits::default() });
    rec.tensor::<f32>("huge", 1 << 20);
    let error = rec.finish().unwrap_err();
    let Error::Memory { what, needed, available } = &error else { panic!("{error}") };
    assert!(what.contains("huge"), "{what}");
    assert_eq!((*needed, *available), (4 << 20, 1 << 20));
}

#[test]
fn more_than_the_memory_there_is_is_refused_before_it_is_touched() {
    let limits = device().limits();
    let mut rec = Recorder::new(limits);
    let half_gib = 512 << 20;
    let count = limits.memory_bytes / half_gib + 1;
    for _ in 0..count {
        rec.constant::<u8>("table", half_gib as usize);
    }
    let plan = rec.finish().unwrap();
    assert_eq!(plan.arena_bytes(), count * half_gib);
    let error = Run::new(device(), plan).map(|_| ()).unwrap_err();
    let Error::Memory { needed, available, .. } = &error else { panic!("{error}") };
    // Other tests may hold some memory.
    assert!(*needed == count * half_gib && *available <= limits.memory_bytes, "{error}");
}

#[test]
fn a_group_count_beyond_the_device_is_refused() {
    let mut rec = Recorder::new(&Limits::default());
    let (left, right) = (rec.input::<f32>("left", 1), rec.input::<f32>("right", 1));
    let out = rec.tensor::<f32>("out", 1);
    rec.dispatch_groups(Add { left, right, out, count: 1 }, [1, 70_000, 1]);
    let error = rec.finish().unwrap_err();
    assert!(matches!(&error, Error::Argument { what, .. } if what.contains("ops/add")), "{error}");
}

fn network_map(limits: &Limits, views: usize, observe: bool) -> (Vec<ArenaRow>, u64) {
    let network = Network::new(&architectures::golden("micro"), limits, Arithmetic::EXACT);
    let grid = ViewGrid { views, rows: 4, columns: 5, patch_size: 14 };
    let mut rec = Recorder::new(limits);
    if observe {
        rec = rec.observing();
    }
    network.record(
        &mut rec,
        Shape { grid, tokens: grid.tokens() / 2, kept: TokenSampling::Kmeans(5), cameras: true, kv_pool: KvPool::ALL },
    );
    let plan = rec.finish().unwrap();
    (plan.arena_map(), plan.arena_bytes())
}

#[test]
fn a_plan_is_a_function_of_its_shape() {
    let limits = Limits::default();
    let text = |map: &[ArenaRow]| map.iter().map(|row| format!("{row:?}")).collect::<Vec<_>>();
    let (map, bytes) = network_map(&limits, 3, false);
    let (again, bytes_again) = network_map(&limits, 3, false);
    assert_eq!((text(&map), bytes), (text(&again), bytes_again));
    assert!(network_map(&limits, 4, false).1 > bytes);
    assert!(network_map(&limits, 3, true).1 > bytes, "what is observed is kept to the end");
}

#[test]
fn living_tensors_of_a_network_never_share_bytes() {
    for max_block_bytes in [1 << 18, 4 << 30] {
        let (map, bytes) = network_map(&Limits { max_block_bytes, ..Limits::default() }, 3, false);
        for (i, a) in map.iter().enumerate() {
            assert!(a.offset + a.bytes <= max_block_bytes, "{a:?}");
            for b in &map[i + 1..] {
                let alive_at_once = a.first_use <= b.last_use && b.first_use <= a.last_use;
                let overlap = a.block == b.block && a.offset < b.offset + b.bytes && b.offset < a.offset + a.bytes;
                assert!(!(alive_at_once && overlap), "{a:?} and {b:?}");
            }
        }
        assert!(bytes < map.iter().map(|row| row.bytes).sum::<u64>() / 3, "dead tensors share");
    }
}
