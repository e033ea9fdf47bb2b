// An OpenMM::Integrator whose steps Python describes, the platforms Reference and CPU, and what Python calls.
#include "steps.h"
#include "openmm/Context.h"
#include "openmm/Platform.h"
#include "openmm/internal/ThreadPool.h"
#include "openmm/reference/ReferencePlatform.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/SerializationProxy.h"
#include <dlfcn.h>

namespace kcons {

// Python's part in the making: fills steps for an integrator, an OpenMM::Integrator*; returns 0 where it cannot.
typedef int (*Planner)(Steps* steps, const void* integrator, const char* description, const char* platform, int groups);
static Planner planner = nullptr;
static thread_local string failure;   // what Python or a C function has to say

// -- Reference and CPU ------------------------------------------------------------------------------------

// Kernels are C++, which Python has compiled to a library; a thread is a work-group of one item. See `kernels.py`.
typedef void (*PlainKernel)(void** pointers, const void* numbers, int group, int groups);

class PlainSteps : public Steps {
public:
    PlainSteps(ContextImpl& c, bool parallel)
            : data(*static_cast<ReferencePlatform::PlatformData*>(c.getPlatformData())), parallel(parallel) {}
    ~PlainSteps() { if (library != nullptr) dlclose(library); }
    vector<double> read(const string& name) override {
        const Array& array = declared(name);
        return array.whole ? vector<double>(integers[name].begin(), integers[name].end()) : array.values;
    }
    void write(const string& name, const vector<double>& values) override {
        copy(values.begin(), values.end(), declared(name, values.size()).values.begin());
        if (integers.count(name)) copy(values.begin(), values.end(), integers[name].begin());
    }
    void prepare(ContextImpl& c) override {
        for (double mass : given["masses"]) inverse.push_back(mass == 0 ? 0 : 1/mass);
        forces.resize(slots);
        for (auto& array : arrays) {
            if (array.whole) integers[array.name].assign(array.values.begin(), array.values.end());
            if (array.passed) own.push_back(array.whole ? (void*) integers[array.name].data() : (void*) array.values.data());
        }
        library = dlopen(Steps::library.c_str(), RTLD_NOW | RTLD_LOCAL);
        if (library == nullptr) throw OpenMMException(string("kcons: ")+dlerror());
    }
    void launch(const string& kernel) override {
        PlainKernel& code = kernels[kernel];
        if (code == nullptr) code = (PlainKernel) dlsym(library, kernel.c_str());
        vector<void*> pointers = {data.positions->data(), data.velocities->data(), inverse.data()};
        for (auto& kept : forces) pointers.push_back(slots == 1 ? data.forces->data() : kept.data());
        pointers.insert(pointers.end(), own.begin(), own.end());
        const Numbers given = numbers;
        numbers.launch++;
        // A sum of few shares does not depend on the number of threads more than one of many.
        int groups = parallel && kernel != "look" ? min(data.threads.getNumThreads(), 256) : 1;
        if (groups == 1) { code(pointers.data(), &given, 0, 1); return; }
        data.threads.execute([&](ThreadPool&, int thread) { if (thread < groups) code(pointers.data(), &given, thread, groups); });
        data.threads.waitForThreads();
    }
protected:
    void keepForces(int slot) override { forces[slot] = *data.forces; }
private:
    ReferencePlatform::PlatformData& data;
    const bool parallel;
    void* library = nullptr;
    map<string, PlainKernel> kernels;
    map<string, vector<int>> integers;
    vector<void*> own;             // where arrays are, in the order of the plan
    vector<double> inverse;
    vector<vector<Vec3>> forces;
};

map<string, Maker>& makers() {
    static map<string, Maker> known = {
        {"Reference", [](ContextImpl& c, const vector<int>&) { return new PlainSteps(c, false); }},
        {"CPU", [](ContextImpl& c, const vector<int>&) { return new PlainSteps(c, true); }}};
    return known;
}

// -- the integrator, as OpenMM wants it -----------------------------------------------------------------

class ProgramIntegrator : public Integrator {
public:
    string description;            // what Python makes steps of
    vector<int> tied;
    mutable Shared shared;
    void step(int count) override {
        Steps& s = prepared();
        fill_n(shared.told, 7, 0);
        try {
            s.execute(*context, *this, shared, count);
        } catch (...) {
            shared.told[1] = -1;
            s.valid = false;
            if (s.read("failure")[0] == 0) throw;
            s.launch("look");                      // it came of a failure, which is told
        }
        shared.moved = 0;                          // by barostats, which keep to the constraints
        vector<double> told = s.read("looked");    // the only wait of a call
        copy(told.begin(), told.end(), shared.told);
        if (told[2] != 0 || count == 0) shared.told[1] = -1;
        if (told[2] != 0) {
            s.write("failure", {0, 0, 0});
            s.valid = false;
            throw OpenMMException("kcons: row "+to_string((int) told[4])+" could not be solved at step "+to_string((int) told[3]));
        }
    }
    // The steps with all that they need, which is made when it is used first.
    Steps& prepared() const {
        if (steps == nullptr) throw OpenMMException("This Integrator is not bound to a context!");
        if (shared.planned) return *steps;
        const System& system = context->getSystem();
        auto& given = steps->given;
        given.clear();
        for (int k = 0; k < system.getNumParticles(); k++) given["masses"].push_back(system.getParticleMass(k));
        for (int k = 0; k < system.getNumConstraints(); k++) {
            int i, j; double length;
            system.getConstraintParameters(k, i, j, length);
            given["constraints"].insert(given["constraints"].end(), {double(i), double(j), length});
        }
        vector<Vec3> positions, box(3);
        context->getPositions(positions);
        if (system.usesPeriodicBoundaryConditions()) context->getPeriodicBoxVectors(box[0], box[1], box[2]);
        for (auto& place : positions) given["positions"].insert(given["positions"].end(), &place[0], &place[0]+3);
        for (auto& edge : box) given["box"].insert(given["box"].end(), &edge[0], &edge[0]+3);
        given["time"] = {context->getTime()};
        string platform = context->getPlatform().getName();
        if (!planner(steps.get(), static_cast<const Integrator*>(this), description.c_str(), platform.c_str(), getIntegrationForceGroups()))
            throw OpenMMException(failure);
        steps->prepare(*context);
        shared.planned = 1;
        return *steps;
    }
protected:
    void initialize(ContextImpl& c) override {
        if (owner != nullptr && &c.getOwner() != owner)
            throw OpenMMException("This Integrator is already bound to a context");
        if (planner == nullptr)
            throw OpenMMException("kcons: this integrator is made for its Context by Python; import kcons.openmm");
        auto maker = makers().find(c.getPlatform().getName());
        if (maker == makers().end())
            throw OpenMMException("kcons: there are no steps on the platform "+c.getPlatform().getName()+"; give device=False");
        // The base class tells the Context when the integrator goes first.
        owner = &c.getOwner();
        context = &c;
        steps.reset(maker->second(c, tied));
        shared.told[1] = -1;
        shared.bound = 1;
    }
    void cleanup() override {
        steps.reset();
        shared.bound = shared.planned = 0;
    }
    vector<string> getKernelNames() override { return {}; }
    void stateChanged(State::DataType changed) override {
        if (steps == nullptr) return;
        if (changed != State::Velocities) steps->valid = false;
        if (changed == State::Positions || changed == State::Velocities) shared.moved = 1;
    }
    double computeKineticEnergy() override {
        const double middle = shared.told[1], end = shared.told[6];
        steps->valid = false;                      // forces of other groups may be there than energies were asked of last
        if (middle >= 0) steps->launch("look");
        if (middle >= 0 && fabs(steps->read("looked")[6]-end) <= 1e-7*end) return middle/2;   // else others left other velocities
        vector<Vec3> v;
        double sum = 0;
        context->getVelocities(v);
        for (size_t k = 0; k < v.size(); k++) sum += context->getSystem().getParticleMass(k)*v[k].dot(v[k]);
        return sum/2;
    }
    bool kineticEnergyRequiresForce() const override { return false; }
    void createCheckpoint(ostream& out) const override { out << saved() << '\n'; }
    void loadCheckpoint(istream& in) override {
        string text;
        getline(in, text);
        // Where constraints were added, `Context::reinitialize` brings what belongs to fewer rows.
        restore(text, false);
        steps->valid = false; steps->last = 0;     // its noise comes again
    }
    void serializeParameters(SerializationNode& node) const override {
        node.setIntProperty("version", 1).setStringProperty("state", saved());
    }
    void deserializeParameters(const SerializationNode& node) override {
        string text = node.getStringProperty("state", "");
        if (!text.empty()) restore(text, true);    // else it is the state of another integrator
    }
private:
    // All that belongs to a state beside x and v: numbers.
    string saved() const {
        ostringstream text;
        text.precision(17);
        text << shared.told[1] << ' ' << shared.told[6];
        for (auto& array : prepared().arrays) if (array.saved) {
            text << ' ' << array.name << ' ' << array.values.size();
            for (double value : steps->read(array.name)) text << ' ' << value;
        }
        return text.str();
    }
    // `exactly` that of these rows, but for its noise; else arrays of other rows stay as they are.
    void restore(const string& text, bool exactly) {
        istringstream words(text);
        map<string, vector<double>> found;
        double middle, end, value;
        words >> middle >> end;
        string name;
        for (long size; words >> name >> size;)
            while (size-- > 0 && words >> value) found[name].push_back(value);
        bool known = words.eof();
        for (auto& array : prepared().arrays) if (array.saved && found[array.name].size() != array.values.size()) {
            known = known && !exactly && array.name != "memory";
            found.erase(array.name);
        }
        if (!known)
            throw OpenMMException("kcons: this state belongs to other steps or rows; OpenMM has taken over its positions and velocities, and the rest of it is left out");
        for (auto& array : steps->arrays) if (found.count(array.name) && !(exactly && array.name == "seed"))
            steps->write(array.name, found[array.name]);
        shared.told[1] = middle; shared.told[6] = end;
    }
    unique_ptr<Steps> steps;
};

class Proxy : public SerializationProxy {
public:
    Proxy() : SerializationProxy("KconsProgram") {}
    void serialize(const void* object, SerializationNode& node) const override {
        auto& i = *static_cast<const ProgramIntegrator*>(static_cast<const Integrator*>(object));
        node.setIntProperty("version", 1).setDoubleProperty("stepSize", i.getStepSize());
        node.setDoubleProperty("constraintTolerance", i.getConstraintTolerance());
        node.setIntProperty("forceGroups", i.getIntegrationForceGroups());
        node.setStringProperty("description", i.description);
    }
    void* deserialize(const SerializationNode& node) const override {
        ProgramIntegrator* i = new ProgramIntegrator();
        i->setStepSize(node.getDoubleProperty("stepSize"));
        i->setConstraintTolerance(node.getDoubleProperty("constraintTolerance"));
        i->setIntegrationForceGroups(node.getIntProperty("forceGroups", -1));
        i->description = node.getStringProperty("description");
        return static_cast<Integrator*>(i);
    }
};
static const bool registered = (SerializationProxy::registerProxy(typeid(ProgramIntegrator), new Proxy()), true);

}

// -- what Python calls; `integrator` is int(proxy.this) of the SWIG proxy, an OpenMM::Integrator* -----------

using namespace kcons;

static ProgramIntegrator& own(void* integrator) {
    return dynamic_cast<ProgramIntegrator&>(*static_cast<Integrator*>(integrator));
}
extern "C" {
const char* kcons_error() { return failure.c_str(); }
void kcons_set_error(const char* text) { failure = text; }
void kcons_set_planner(Planner p) { planner = p; }
void kcons_describe(void* integrator, const char* description, const int* tied, int n) {
    own(integrator).description = description;
    own(integrator).tied.assign(tied, tied+n);
}
Shared* kcons_shared(void* integrator) { return &own(integrator).shared; }
// The values of an array, until the next is read; null where that fails.
const double* kcons_read(void* integrator, const char* name, int* n) try {
    static thread_local vector<double> values;
    values = own(integrator).prepared().read(name);
    *n = values.size();
    return values.data();
} catch (exception& e) { failure = e.what(); return nullptr; }
int kcons_write(void* integrator, const char* name, const double* values, int n) try {
    own(integrator).prepared().write(name, vector<double>(values, values+n));
    return n;
} catch (exception& e) { failure = e.what(); return -1; }
const double* kcons_given(Steps* steps, const char* name, int* n) {
    *n = steps->given[name].size();
    return steps->given[name].data();
}
void kcons_source(Steps* steps, const char* source, const char* library, int items, int workGroup, int slots) {
    steps->arrays.clear();
    for (auto& part : steps->parts) part.clear();
    steps->source = source; steps->library = library;
    steps->items = items; steps->workGroup = workGroup; steps->slots = slots;
}
void kcons_array(Steps* steps, const char* name, int whole, int saved, int passed, const double* values, int n) {
    steps->arrays.push_back({name, whole != 0, saved != 0, passed != 0, vector<double>(values, values+n)});
}
void kcons_action(Steps* steps, int part, const char* kernel, int groups, int slot) {
    steps->parts[part].push_back({kernel, groups, slot});
}
}
