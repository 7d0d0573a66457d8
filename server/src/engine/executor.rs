//! The model's thread: takes commands in, computes what the schedulers say, lets models go.
//!
//! A tick at a time: first the observes of all models, then steps of rollouts, for which models share the time of a
//! tick. Blocks of one model are computed some at once, each by a worker, which is a thread for as long as that takes. While there is work nothing here waits, but for observes that come at the same time as others.

use std::{
    collections::BTreeMap,
    sync::Arc,
    thread::sleep,
    time::{Duration, Instant},
};

use tokio::sync::mpsc::{self, error::TryRecvError};

use super::{
    EngineConfig,
    commands::Command,
    door::Door,
    models::ModelId,
    scheduler::{JobId, Tick},
    served::Served,
};

/// How long an observe waits for others to share its block, where blocks hold more than one: a row costs less among
/// others, and robots that were answered together come again together.
const GATHER: Duration = Duration::from_millis(2);

/// How often they are looked for.
const LOOK: Duration = Duration::from_micros(100);

/// The state of the model's thread.
pub(super) struct Executor {
    served: BTreeMap<ModelId, Served>,
    commands: mpsc::Receiver<Command>,
    door: Arc<Door>,
    config: EngineConfig,
    next_job: u64,
    stopped: bool,
}

impl Executor {
    pub(super) fn new(
        config: EngineConfig,
        door: Arc<Door>,
        commands: mpsc::Receiver<Command>,
    ) -> Self {
        Self { served: BTreeMap::new(), commands, door, config, next_job: 0, stopped: false }
    }

    /// Works until nobody can ask any more, or it is stopped.
    pub(super) fn run(mut self) {
        while !self.stopped {
            self.forget_unused_models();
            if self.served.values().all(|served| served.scheduler().is_idle()) {
                match self.commands.blocking_recv() {
                    Some(command) => self.accept(command),
                    None => return,
                }
            }
            while let Ok(command) = self.commands.try_recv() {
                self.accept(command);
            }
            self.gather();
            self.tick();
        }
    }

    fn gather(&mut self) {
        let until = Instant::now() + GATHER;
        while self.served.values().any(|served| served.scheduler().has_room(self.config.workers))
            && Instant::now() < until
        {
            match self.commands.try_recv() {
                Ok(command) => self.accept(command),
                Err(TryRecvError::Empty) => sleep(LOOK),
                Err(TryRecvError::Disconnected) => return,
            }
        }
    }

    fn accept(&mut self, command: Command) {
        let id = JobId(self.next_job);
        self.next_job += 1;
        // A request holds on to its model, and commands come in order, so the model is there.
        match command {
            Command::Observe(order) => {
                if let Some(served) = self.served.get_mut(&order.job.model.id) {
                    served.add_observe(id, order);
                }
            }
            Command::Imagine(order) => {
                if let Some(served) = self.served.get_mut(&order.job.model.id) {
                    served.add_rollout(id, order);
                }
            }
            Command::Serve(newcomer) => {
                let (id, sizes) = (newcomer.id, self.config.sizes);
                self.served.insert(id, Served::new(newcomer, sizes, Arc::clone(&self.door)));
            }
            Command::Unused => {}
            Command::Stop => self.stopped = true,
        }
    }

    fn forget_unused_models(&mut self) {
        self.served.retain(|_, served| !served.is_unused());
    }

    fn tick(&mut self) {
        self.door.gauges.tick();
        let rolling = self.served.values().filter(|served| served.scheduler().is_rolling());
        let time = self.config.tick / (rolling.count().max(1) as u32);
        let workers = self.config.workers;
        let next =
            self.served.iter_mut().map(|(id, served)| (*id, served.next_tick(time, workers)));
        let ticks: Vec<(ModelId, Tick)> = next.collect();
        let tenants = self.served.values().map(|served| served.scheduler().tenants());
        self.door.shared_by(tenants.sum());
        for (id, tick) in &ticks {
            let Some(served) = self.served.get_mut(id) else { continue };
            for blocks in tick.seeing.chunks(workers).chain(tick.blind.chunks(workers)) {
                served.observe(blocks);
            }
        }
        for (id, tick) in &ticks {
            let Some(served) = self.served.get_mut(id) else { continue };
            for blocks in tick.imagine.chunks(workers) {
                served.imagine(blocks);
            }
        }
    }
}
