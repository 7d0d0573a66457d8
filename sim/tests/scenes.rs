//! The scenes as a planner meets them: what an episode shows, what actions do, what is refused.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use gatsbi_sim::{
    AGENT, BACKGROUND, Environment, Error, FIRST_OBJECT, Goal, HandMove, Observation, Scene,
};

/// Plays `steps` steps of the script.
fn play(scene: &mut dyn Environment, seed: u64, steps: usize) -> Vec<(Observation, Vec<f32>)> {
    let mut seen = scene.reset(seed).unwrap();
    (0..steps)
        .map(|_| {
            let action = scene.scripted_action().unwrap();
            let next = scene.step(&action).unwrap();
            (std::mem::replace(&mut seen, next), action)
        })
        .collect()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

fn hand(seen: &Observation) -> [f64; 7] {
    seen.state.ee_pose.unwrap()
}

/// Middle of the pixels with a label, if there are at least `least`.
fn middle(mask: &[u8], width: usize, label: u8, least: usize) -> Option<[f64; 2]> {
    let seen: Vec<usize> = (0..mask.len()).filter(|&at| mask[at] == label).collect();
    let mean = |part: &dyn Fn(usize) -> usize| seen.iter().map(|&at| part(at) as f64).sum::<f64>();
    let count = seen.len() as f64;
    (seen.len() >= least).then(|| [mean(&|at| at % width) / count, mean(&|at| at / width) / count])
}

/// What every scene with a robot must show in a whole episode.
fn check_robot_scene(name: Scene, seed: u64) {
    let mut scene = name.open(64).unwrap();
    let spec = scene.spec().clone();
    let frames = play(scene.as_mut(), seed, spec.frames);
    let mut touched = 0;
    for (t, (seen, _)) in frames.iter().enumerate() {
        let (objects, mask) = (&seen.state.objects, &seen.mask);
        assert_eq!((seen.rgb.len(), mask.len()), (64 * 64 * 3, 64 * 64));
        assert_eq!(seen.state.step, t);
        assert!(mask.iter().all(|&label| usize::from(label) < objects.len() + 2));
        let pixels = |wanted| mask.iter().map(|&label| usize::from(label == wanted)).sum::<usize>();
        let agent = pixels(AGENT);
        assert!((60..1000).contains(&agent), "{name} {t}: the agent has {agent} pixels");
        assert!(pixels(BACKGROUND) > 2000);
        for (i, object) in objects.iter().enumerate() {
            let [x, y, z] = object.position;
            assert!((0.25..0.93).contains(&x) && y.abs() < 0.33, "{name} {t}: {object:?}");
            assert!((0.02..0.08).contains(&z), "{name} {t}: {object:?}");
            // Half of it or more is to be seen.
            if let Some(at) = middle(mask, 64, FIRST_OBJECT + i as u8, 25) {
                assert!(distance(&at, &object.pixel) < 3.0, "{name} {t}: {at:?} {object:?}");
            }
        }
        assert!((0.02..0.12).contains(&hand(seen)[2]), "{name} {t}: {:?}", hand(seen));
        touched += usize::from(seen.state.contacts_agent.contains(&true));
    }
    assert!(frames[0].0.state.contacts_agent.iter().all(|&touches| !touches));
    assert!(touched > 2, "{name}: the agent touched in {touched} frames");
    // It moves, and the picture with it.
    let first = &frames[0].0;
    let far = frames.iter().map(|(seen, _)| distance(&hand(seen)[..3], &hand(first)[..3]));
    assert!(far.fold(0.0, f64::max) > 0.1);
    assert_ne!(frames[spec.frames - 1].0.rgb, first.rgb);
}

#[test]
fn a_panda_pushes() {
    check_robot_scene(Scene::Push1, 3);
}

#[test]
fn a_panda_plays() {
    check_robot_scene(Scene::Push1Play, 3);
}

#[test]
fn a_panda_strikes_balls() {
    check_robot_scene(Scene::Roll, 3);
}

#[test]
fn a_panda_goes_around_and_strikes_balls() {
    check_robot_scene(Scene::RollCycle, 3);
}

#[test]
fn a_sawyer_pushes() {
    check_robot_scene(Scene::Push2, 3);
}

#[test]
fn an_episode_depends_on_its_seed_alone() {
    let mut scene = Scene::Push1.open(64).unwrap();
    let first = play(scene.as_mut(), 7, 6);
    let other = play(scene.as_mut(), 8, 3);
    assert_ne!(first[2].0.state, other[2].0.state);
    assert_eq!(play(scene.as_mut(), 7, 6), first);
}

#[test]
fn actions_explain_all_that_happens() {
    for (name, steps) in [(Scene::Push1, 10), (Scene::Push2, 20)] {
        let mut scene = name.open(16).unwrap();
        let played = play(scene.as_mut(), 5, steps);
        let mut seen = scene.reset(5).unwrap();
        for (expected, action) in played {
            assert_eq!(seen.state, expected.state);
            seen = scene.step(&action).unwrap();
        }
    }
}

#[test]
fn a_hand_goes_where_it_is_sent() {
    let mut scene = Scene::Push2.open(16).unwrap();
    let before = hand(&scene.reset(2).unwrap());
    // Up first, where nothing is in the way, then sideways.
    for _ in 0..3 {
        scene.step(&[0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0]).unwrap();
    }
    let side = if before[1] > 0.0 { -0.04 } else { 0.04 };
    let mut after = before;
    for _ in 0..4 {
        after = hand(&scene.step(&[0.0, side, 0.0, 0.0, 0.0, 0.0, 1.0]).unwrap());
    }
    let still = scene.step(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).unwrap();
    let expected = [before[0], before[1] + 4.0 * f64::from(side), before[2] + 0.15];
    assert!(distance(&hand(&still)[..3], &expected) < 0.005, "{still:?} {expected:?} {after:?}");
    // The fingers are open by now.
    let [left, right] = [still.state.joint_positions[7], still.state.joint_positions[8]];
    assert!(left > 0.015 && right < -0.015, "{left} {right}");
}

#[test]
fn joints_turn_at_the_speed_they_are_told() {
    let mut scene = Scene::Push1.open(16).unwrap();
    let before = scene.reset(2).unwrap().state.joint_positions;
    let action = [0.0, -0.4, 0.0, 0.3, 0.0, 0.0, 0.5];
    let mut after = before.clone();
    for _ in 0..5 {
        after = scene.step(&action).unwrap().state.joint_positions;
    }
    for joint in 0..7 {
        let turned = after[joint] - before[joint];
        assert!((turned - f64::from(action[joint])).abs() < 0.02, "{joint}: {turned}");
    }
}

#[test]
fn a_goal_is_shown_and_changes_nothing() {
    let mut scene = Scene::Push1.open(64).unwrap();
    let first = scene.reset(7).unwrap();
    let action = scene.scripted_action().unwrap();
    let expected = scene.step(&action).unwrap();

    assert_eq!(scene.reset(7).unwrap(), first);
    let objects = first.state.objects.len();
    let mut goal = Goal { objects: vec![None; objects] };
    goal.objects[1] = Some([0.7, -0.2]);
    let shown = scene.set_goal(&goal).unwrap();
    assert_eq!(shown.state.objects[0], first.state.objects[0]);
    let [x, y, _] = shown.state.objects[1].position;
    assert!(distance(&[x, y], &[0.7, -0.2]) < 1e-12);
    let at = middle(&shown.mask, 64, FIRST_OBJECT + 1, 10).unwrap();
    assert!(distance(&at, &shown.state.objects[1].pixel) < 2.0);

    scene.scripted_action().unwrap();
    let mut seen = scene.step(&action).unwrap();
    let [x, y, _] = seen.state.objects[1].position;
    let away = distance(&[x, y], &[0.7, -0.2]);
    assert!((seen.state.goal_distance.take().unwrap() - away).abs() < 1e-12);
    assert_eq!(seen, expected);
}

#[test]
fn what_is_refused_changes_nothing() {
    let mut scene = Scene::Push1.open(16).unwrap();
    assert!(matches!(scene.step(&[0.0; 7]), Err(Error::NotReset)));
    assert!(matches!(scene.scripted_action(), Err(Error::NotReset)));
    assert!(matches!(scene.set_goal(&Goal::default()), Err(Error::NotReset)));
    let first = scene.reset(4).unwrap();
    let found = first.state.objects.len();
    assert!(matches!(
        scene.step(&[0.0; 6]),
        Err(Error::ActionLength { found: 6, expected: 7, .. })
    ));
    assert!(matches!(scene.step(&[f32::NAN; 7]), Err(Error::ActionValue { .. })));
    assert!(matches!(scene.step(&[2.2; 7]), Err(Error::ActionValue { .. })));
    assert!(matches!(
        scene.set_goal(&Goal::default()),
        Err(Error::GoalLength { found: 0, expected }) if expected == found
    ));
    let mut goal = Goal { objects: vec![None; found] };
    goal.objects[2] = Some([1.5, f64::NAN]);
    let error = scene.set_goal(&goal).unwrap_err().to_string();
    assert_eq!(
        error,
        "the goal puts object 2 at 1.5, NaN m, outside the tray (x 0.28 to 0.76 m, y -0.28 to 0.28 m)"
    );
    let after = scene.step(&[0.0; 7]).unwrap();
    assert_eq!((after.state.step, after.state.goal_distance), (1, None));
    assert!(matches!(Scene::Roll.open(8), Err(Error::Size { found: 8 })));
}

#[test]
fn futures_come_true_and_nothing_has_moved() {
    for name in [Scene::Push1, Scene::Push2] {
        let mut scene = name.open(16).unwrap();
        play(scene.as_mut(), 5, 6);
        let moves = scene.hand_moves(&[vec![[0.03, 0.0]; 3], vec![[0.0, -0.03]; 3]]).unwrap();
        let actions = |way: &Vec<HandMove>| way.iter().map(|step| step.action.clone()).collect();
        let candidates: Vec<Vec<Vec<f32>>> = moves.iter().map(actions).collect();
        let futures = scene.futures(&candidates).unwrap();
        assert_eq!(futures, scene.futures(&candidates).unwrap());
        assert_ne!(futures[0], futures[1]);
        for (step, action) in candidates[1].iter().enumerate() {
            let seen = scene.step(action).unwrap();
            assert_eq!(seen.state.objects, futures[1][step], "{name} {step}");
            // The gripper of push2 follows its target, later.
            let off = distance(&hand(&seen)[..3], &moves[1][step].position);
            assert!(name == Scene::Push2 || off < 0.015, "{name} {step}: the hand is {off} m off");
        }
        let short = scene.futures(&[vec![vec![0.0]]]);
        assert!(matches!(short, Err(Error::ActionLength { found: 1, .. })));
    }
    let mut nobody = Scene::Balls3.open(16).unwrap();
    nobody.reset(1).unwrap();
    assert!(matches!(nobody.futures(&[]), Err(Error::NobodyActs { .. })));
    assert!(matches!(nobody.hand_moves(&[]), Err(Error::NobodyActs { .. })));
    let mut early = Scene::Push1.open(16).unwrap();
    assert!(matches!(early.futures(&[]), Err(Error::NotReset)));
}
