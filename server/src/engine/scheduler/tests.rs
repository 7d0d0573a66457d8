//! Examples of what the scheduler forms, and what holds whatever happens to it.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use proptest::prelude::*;

use super::*;

const SIZES: Sizes = Sizes { observe_block: 2, imagine_block: 4, wide_block: 4, slots: 32 };

fn steps(tick: &Tick) -> Vec<(u64, u32, u32)> {
    let steps = tick.imagine.iter().flatten().flatten();
    steps.map(|step| (step.job.0, step.row, step.depth)).collect()
}

fn observe(scheduler: &mut Scheduler, job: u64, seeing: bool, urgency: Urgency, lane: u64) {
    scheduler.observe(JobId(job), (seeing, urgency), lane, None);
}

/// A rollout of `rows` rows in neighbouring lanes, from the first on.
fn imagine(scheduler: &mut Scheduler, job: u64, tenant: u128, (rows, horizon): (u64, u32)) {
    scheduler.imagine(JobId(job), Tenant(tenant), 0..rows, horizon, None);
}

/// Row steps of each job over `ticks` ticks of one block.
fn counts(scheduler: &mut Scheduler, ticks: usize) -> BTreeMap<u64, usize> {
    let mut counts = BTreeMap::new();
    for _ in 0..ticks {
        for (job, ..) in steps(&scheduler.tick(Instant::now(), 1, 1)) {
            *counts.entry(job).or_default() += 1;
        }
    }
    counts
}

#[test]
fn a_block_has_room_while_an_observe_waits_alone_in_it() {
    let mut scheduler = Scheduler::new(SIZES);
    assert!(!scheduler.has_room(1), "nobody waits");
    for (job, room) in [(0, true), (1, false)] {
        observe(&mut scheduler, job, true, Urgency::Live, job);
        assert_eq!(scheduler.has_room(1), room);
    }
}

#[test]
fn all_live_observes_go_at_once_images_apart() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    for (job, seeing, lane) in
        [(0, true, 0), (1, false, 4), (2, true, 1), (3, true, 2), (4, true, 6)]
    {
        observe(&mut scheduler, job, seeing, Urgency::Live, lane);
    }
    let tick = scheduler.tick(now, 1, 1);
    let job = |id: u64| Some(JobId(id));
    assert_eq!(
        tick.seeing,
        [vec![job(0), job(2)], vec![job(3), None], vec![job(4), None]],
        "even lanes are the first"
    );
    assert_eq!(tick.blind, [vec![job(1), None]]);
    assert!(scheduler.is_idle());
}

#[test]
fn bulk_observes_fill_gaps_and_share_the_time_of_rollouts() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    observe(&mut scheduler, 0, true, Urgency::Live, 0);
    for job in 1..8 {
        observe(&mut scheduler, job, true, Urgency::Bulk, job);
    }
    imagine(&mut scheduler, 9, 0, (8, 2));
    let tick = scheduler.tick(now, 2, 1);
    let job = |id: u64| Some(JobId(id));
    assert_eq!(tick.seeing, [vec![job(0), job(1)], vec![job(2), job(3)]]);
    assert_eq!(tick.imagine.len(), 1, "one of two blocks went to bulk observes");
    assert_eq!(scheduler.tick(now, 2, 1).seeing, [vec![job(4), job(5)]]);
    assert_eq!(scheduler.tick(now, 1, 1).seeing, [vec![job(6), job(7)]]);
    assert_eq!(steps(&scheduler.tick(now, 1, 1)).len(), 4);
    assert!(scheduler.is_idle());
}

#[test]
fn a_rollout_keeps_few_rows_on_their_way() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    imagine(&mut scheduler, 7, 0, (6, 2));
    assert_eq!(steps(&scheduler.tick(now, 1, 1)), [(7, 0, 1), (7, 1, 1), (7, 2, 1), (7, 3, 1)]);
    assert_eq!(steps(&scheduler.tick(now, 1, 1)), [(7, 0, 2), (7, 1, 2), (7, 2, 2), (7, 3, 2)]);
    assert_eq!(steps(&scheduler.tick(now, 1, 1)), [(7, 4, 1), (7, 5, 1)]);
    assert!(!scheduler.is_idle());
    assert_eq!(steps(&scheduler.tick(now, 1, 1)), [(7, 4, 2), (7, 5, 2)]);
    assert!(scheduler.is_idle());
}

#[test]
fn rows_that_find_their_lane_taken_let_others_pass() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    let lanes = [0, 4, 8, 1].into_iter();
    scheduler.imagine(JobId(3), Tenant(0), lanes, 1, None);
    assert_eq!(steps(&scheduler.tick(now, 1, 1)), [(3, 0, 1), (3, 3, 1)]);
    assert_eq!(steps(&scheduler.tick(now, 2, 1)), [(3, 1, 1), (3, 2, 1)]);
}

#[test]
fn whoever_comes_later_joins_at_the_next_tick() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    imagine(&mut scheduler, 1, 1, (8, 3));
    scheduler.tick(now, 1, 1);
    scheduler.imagine(JobId(2), Tenant(2), [2, 3].into_iter(), 1, None);
    let tick = scheduler.tick(now, 1, 1);
    assert_eq!(steps(&tick), [(1, 0, 2), (1, 1, 2), (2, 0, 1), (2, 1, 1)]);
    // What the second left is taken by the first again, each row at its own depth.
    let mut tick = steps(&scheduler.tick(now, 2, 1));
    tick.sort_unstable();
    assert_eq!(
        tick,
        [(1, 0, 3), (1, 1, 3), (1, 2, 2), (1, 3, 2), (1, 4, 1), (1, 5, 1), (1, 6, 1), (1, 7, 1)]
    );
}

#[test]
fn a_tenant_with_many_rollouts_gets_no_more_than_one_with_few() {
    let mut scheduler = Scheduler::new(SIZES);
    for job in 0..6 {
        imagine(&mut scheduler, job, 1, (64, 50));
    }
    imagine(&mut scheduler, 6, 2, (64, 50));
    let counts = counts(&mut scheduler, 240);
    let first: usize = (0..6).map(|job| counts[&job]).sum();
    assert_eq!(first + counts[&6], 240 * 4);
    assert!(first.abs_diff(counts[&6]) < 48, "{counts:?}");
    let (least, most) =
        ((0..6).map(|job| counts[&job]).min(), (0..6).map(|job| counts[&job]).max());
    assert!(most.unwrap() - least.unwrap() < 40, "{counts:?}");
}

#[test]
fn rollouts_that_want_the_same_lanes_take_turns() {
    let mut scheduler = Scheduler::new(SIZES);
    imagine(&mut scheduler, 0, 1, (2, 40));
    imagine(&mut scheduler, 1, 1, (2, 40));
    let counts = counts(&mut scheduler, 20);
    assert!(counts[&0].abs_diff(counts[&1]) <= 2, "{counts:?}");
}

#[test]
fn there_is_room_for_whoever_comes() {
    let mut scheduler = Scheduler::new(SIZES);
    imagine(&mut scheduler, 0, 1, (1000, 1000));
    for _ in 0..20 {
        scheduler.tick(Instant::now(), 8, 1);
    }
    assert_eq!(scheduler.free.len(), SIZES.slots / 2, "one tenant holds half of the slots");
    imagine(&mut scheduler, 1, 2, (4, 1));
    let tick = steps(&scheduler.tick(Instant::now(), 8, 1));
    assert_eq!(tick.iter().filter(|(job, ..)| *job == 1).count(), 4);
}

#[test]
fn deadlines_end_what_waits_and_what_is_under_way() {
    let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
    let soon = now + Duration::from_millis(5);
    scheduler.imagine(JobId(1), Tenant(0), 0..4, 9, Some(soon));
    assert_eq!(scheduler.tick(now, 1, 1).expired, []);
    scheduler.observe(JobId(2), (true, Urgency::Live), 0, Some(soon));
    scheduler.observe(JobId(3), (true, Urgency::Bulk), 0, Some(soon));
    let tick = scheduler.tick(soon, 1, 1);
    assert_eq!(tick.expired, [JobId(2), JobId(3), JobId(1)]);
    assert_eq!((tick.seeing, tick.imagine), (Vec::new(), Vec::new()));
    assert!(scheduler.is_idle() && scheduler.free.len() == SIZES.slots);
}

#[test]
fn large_rollouts_go_in_wide_blocks_beside_small_ones() {
    let sizes = Sizes { wide_block: 8, ..SIZES };
    let (mut scheduler, now) = (Scheduler::new(sizes), Instant::now());
    imagine(&mut scheduler, 1, 1, (7, 1));
    imagine(&mut scheduler, 2, 1, (20, 1));
    let shape = |tick: &Tick| -> Vec<(usize, usize)> {
        let rows = |block: &Block<RowStep>| block.iter().flatten().count();
        tick.imagine.iter().map(|block| (block.len(), rows(block))).collect()
    };
    assert_eq!(shape(&scheduler.tick(now, 2, 1)), [(8, 8), (4, 4)], "half of the time each");
    assert_eq!(shape(&scheduler.tick(now, 4, 2)), [(8, 8), (4, 3)]);
    assert_eq!(shape(&scheduler.tick(now, 2, 2)), [(8, 4)], "its last rows");
    imagine(&mut scheduler, 3, 1, (16, 1));
    assert_eq!(shape(&scheduler.tick(now, 2, 2)), [(8, 8), (8, 8)], "one for each worker");
    assert!(scheduler.is_idle());
}

/// What may happen to a scheduler.
#[derive(Clone, Debug)]
enum Event {
    Observe { seeing: bool, bulk: bool, lane: u64 },
    Imagine { tenant: u128, lanes: Vec<u64>, horizon: u32 },
    Cancel { which: usize },
    Tick { blocks: usize },
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        (any::<bool>(), any::<bool>(), any::<u64>())
            .prop_map(|(seeing, bulk, lane)| Event::Observe { seeing, bulk, lane }),
        (0..4u128, proptest::collection::vec(any::<u64>(), 1..20), 1..6u32)
            .prop_map(|(tenant, lanes, horizon)| Event::Imagine { tenant, lanes, horizon }),
        (0..8usize).prop_map(|which| Event::Cancel { which }),
        (1..4usize).prop_map(|blocks| Event::Tick { blocks }),
        (1..4usize).prop_map(|blocks| Event::Tick { blocks }),
    ]
}

/// A rollout as the test knows it.
struct Known {
    horizon: u32,
    lanes: Vec<u64>,
    depths: BTreeMap<u32, (u32, u32)>,
}

/// What the test knows to be under way.
#[derive(Default)]
struct World {
    rollouts: BTreeMap<JobId, Known>,
    /// Images, urgency and lane of observes.
    observes: BTreeMap<JobId, (bool, bool, u64)>,
}

impl World {
    fn check_observes(
        &mut self,
        blocks: &[Block<JobId>],
        seeing: bool,
        size: usize,
    ) -> Result<(), TestCaseError> {
        for block in blocks {
            prop_assert_eq!(block.len(), size);
            prop_assert!(block.iter().any(Option::is_some));
            for (lane, job) in block.iter().enumerate() {
                let Some(job) = job else { continue };
                let known = self.observes.remove(job).unwrap();
                prop_assert_eq!(known.0, seeing);
                prop_assert_eq!(known.2 % size as u64, lane as u64);
            }
        }
        Ok(())
    }

    fn check_steps(
        &mut self,
        blocks: &[Block<RowStep>],
        sizes: Sizes,
    ) -> Result<(), TestCaseError> {
        let mut taken = BTreeSet::new();
        for block in blocks {
            let size = block.len();
            prop_assert!(block.iter().any(Option::is_some));
            for (lane, step) in block.iter().enumerate() {
                let Some(step) = step else { continue };
                let known = self.rollouts.get_mut(&step.job).unwrap();
                prop_assert_eq!(size, sizes.block_for(known.lanes.len()));
                prop_assert_eq!(known.lanes[step.row as usize] % size as u64, lane as u64);
                let (depth, slot) = known.depths.get(&step.row).copied().unwrap_or((0, step.slot));
                prop_assert_eq!((step.depth, step.slot), (depth + 1, slot));
                prop_assert!(step.depth <= known.horizon);
                prop_assert!((step.slot as usize) < sizes.slots && taken.insert(step.slot));
                known.depths.insert(step.row, (step.depth, step.slot));
            }
        }
        Ok(())
    }
}

proptest! {
    /// Every row takes every step once and in order, in its lane and in a slot that nobody else has; live observes
    /// never wait; no tick is larger than it may be and none is empty while there is work; cancelled requests do
    /// not come back; and in the end nothing is left.
    #[test]
    fn every_step_happens_once_in_its_lane(
        events in proptest::collection::vec(event(), 1..60),
        imagine_block in 1..6usize,
        wider in 1..4usize,
        observe_block in 1..4usize,
        slots in 6..20usize,
    ) {
        let wide_block = imagine_block * wider;
        let sizes = Sizes { observe_block, imagine_block, wide_block, slots };
        let (mut scheduler, now) = (Scheduler::new(sizes), Instant::now());
        let mut world = World::default();
        let drain = std::iter::repeat_n(Event::Tick { blocks: 2 }, 4000);
        for (id, event) in events.into_iter().chain(drain).enumerate() {
            let id = JobId(id as u64);
            match event {
                Event::Observe { seeing, bulk, lane } => {
                    let urgency = if bulk { Urgency::Bulk } else { Urgency::Live };
                    scheduler.observe(id, (seeing, urgency), lane, None);
                    world.observes.insert(id, (seeing, bulk, lane));
                }
                Event::Imagine { tenant, lanes, horizon } => {
                    scheduler.imagine(id, Tenant(tenant), lanes.iter().copied(), horizon, None);
                    world.rollouts.insert(id, Known { horizon, lanes, depths: BTreeMap::new() });
                }
                Event::Cancel { which } => {
                    let jobs = world.rollouts.keys().chain(world.observes.keys());
                    if let Some(&job) = jobs.into_iter().nth(which) {
                        scheduler.cancel(job);
                        world.rollouts.remove(&job);
                        world.observes.remove(&job);
                    }
                }
                Event::Tick { blocks } => {
                    let live = world.observes.values().filter(|(_, bulk, _)| !bulk).count();
                    let waiting = world.observes.len();
                    let tick = scheduler.tick(now, blocks, 1);
                    world.check_observes(&tick.seeing, true, observe_block)?;
                    world.check_observes(&tick.blind, false, observe_block)?;
                    prop_assert!(world.observes.values().all(|(_, bulk, _)| *bulk), "one waits");
                    prop_assert!(waiting == live || world.observes.len() < waiting);
                    let most = live + 2 * blocks.div_ceil(2).max(blocks);
                    prop_assert!(tick.seeing.len() + tick.blind.len() <= most);
                    // Of either size that there is, one is computed at least.
                    let kinds: BTreeSet<usize> = tick.imagine.iter().map(Vec::len).collect();
                    prop_assert!(tick.imagine.len() < blocks + kinds.len().max(1));
                    prop_assert!(world.rollouts.is_empty() || !tick.imagine.is_empty());
                    world.check_steps(&tick.imagine, sizes)?;
                    for known in world.rollouts.values() {
                        let under_way = known.depths.values().filter(|at| at.0 < known.horizon);
                        for (_, slot) in under_way {
                            prop_assert!(!scheduler.free.contains(slot), "free and taken");
                        }
                    }
                    world.rollouts.retain(|_, known| {
                        let done = known.depths.values().filter(|at| at.0 == known.horizon);
                        done.count() < known.lanes.len()
                    });
                }
            }
        }
        prop_assert!(scheduler.is_idle());
        prop_assert_eq!(scheduler.free.len(), slots);
    }

    /// Tenants that all have more to do than fits get the same number of row steps, whatever their rollouts are.
    #[test]
    fn busy_tenants_get_equal_shares(
        rollouts in proptest::collection::vec((0..3u128, 1..10u32), 3..12),
        blocks in 1..4usize,
    ) {
        let mut scheduler = Scheduler::new(Sizes { observe_block: 1, imagine_block: 4, wide_block: 16, slots: 256 });
        let mut steps: BTreeMap<u128, usize> = BTreeMap::new();
        for (job, (tenant, horizon)) in rollouts.iter().enumerate() {
            imagine(&mut scheduler, job as u64, *tenant, (1000, *horizon));
            steps.insert(*tenant, 0);
        }
        for _ in 0..60 {
            for step in scheduler.tick(Instant::now(), blocks, 1).imagine.iter().flatten().flatten() {
                *steps.get_mut(&rollouts[step.job.0 as usize].0).unwrap() += 1;
            }
        }
        let (least, most) = (steps.values().min().unwrap(), steps.values().max().unwrap());
        prop_assert!(most - least <= most / 10 + 8, "{steps:?}");
    }
}
